"""What was planned, proven and flown: below everything that makes or draws it.

They keep, name, save and load; no solver, no simulation and no drawing may enter here.
"""
