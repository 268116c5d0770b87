"""Tests, benchmarks and campaigns: figures are of one numerics thread, as the agent's own commands are."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy loads
