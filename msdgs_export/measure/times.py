"""The times at which exports are compared with their models."""

import math

import numpy as np


def times_to_verify(t0: float, t1: float, count: int) -> list[float]:
    """`count` float32 times in [t0, t1]: both ends, and irregular times between them."""
    golden = (math.sqrt(5) - 1) / 2
    inner = sorted((i * golden) % 1 for i in range(1, count - 1))
    rounded = (float(np.float32(t0 + (t1 - t0) * f)) for f in inner)
    # the float32 neighbors of t0 and t1 may lie outside the range
    return [t0, *(min(max(t, t0), t1) for t in rounded), t1]
