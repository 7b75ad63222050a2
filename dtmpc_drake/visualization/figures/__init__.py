"""Figures for print, one file each; nothing that moves may enter here.

What several of them share: `view` (a plan from above), `cloud` (many flights).
"""
