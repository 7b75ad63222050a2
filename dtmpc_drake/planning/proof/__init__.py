"""The certificate: what a plan keeps, for all times.

It may use the enclosure and the pointwise mathematics, never anything of the search:
that wall is what it is worth, and `make check` holds it.
"""
