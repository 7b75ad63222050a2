"""Benchmarks, printed rather than asserted: ``python -m tests.benchmarks``."""

import os

# Before numpy is loaded: one thread each, so that both sides get the same.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
