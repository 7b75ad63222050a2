"""Benchmarks, printed rather than asserted: ``python -m tests.benchmarks``."""
