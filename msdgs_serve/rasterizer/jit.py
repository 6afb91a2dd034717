"""How every kernel is compiled: GIL released, cached on disk, one set of floating-point freedoms."""

import numba

FAST_MATH = {"nsz", "arcp", "contract"}
"""Fused multiply-add and reciprocals. Not `reassoc`, which breaks the exponential's rounding; not `nnan` and `ninf`,
which would make the tests with NaN and infinity mean nothing."""

kernel = numba.njit(nogil=True, cache=True, fastmath=FAST_MATH, error_model="numpy")
