"""Experiments: diagrams built from the library, and the command line."""
