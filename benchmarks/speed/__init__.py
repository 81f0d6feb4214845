"""The cost of second order, as ratios to a gradient, TRPO or SB3 in the same run."""

import os

# One thread: NumPy and torch read these once, when they are first imported
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
