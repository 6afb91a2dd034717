"""Atomic counters by which threads of compiled kernels share work."""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import lower_builtin, type_callable

from msdgs_serve.rasterizer.jit import kernel

TAKEN, DONE = range(2)
"""Indices of the counters [2] of a piece of work: parts that threads have taken, and parts that are done."""
MAX_POLLS = 5000
"""Polls of other threads' progress, at least 0.03 ms in all; waking a sleeping thread takes twice as long."""


def fetch_add(counters: np.ndarray, place: int, amount: int) -> int:
    """Add to an int64 of `counters` and return its old value. Atomic in compiled code only."""
    before = int(counters[place])
    counters[place] += amount
    return before


@type_callable(fetch_add)
def _type_fetch_add(_context: Any) -> Callable:
    return lambda counters, place, amount: types.int64


@lower_builtin(fetch_add, types.Array, types.Integer, types.Integer)
def _lower_fetch_add(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    place, amount = (context.cast(builder, values[k], signature.args[k], types.int64) for k in (1, 2))
    pointer = cgutils.gep_inbounds(builder, builder.bitcast(data, ir.IntType(64).as_pointer()), place)
    return builder.atomic_rmw("add", pointer, amount, "acq_rel")


@kernel
def all_done(counters: np.ndarray, count: int) -> bool:
    """Whether `count` parts are done; polls for a moment while other threads finish theirs."""
    for _ in range(MAX_POLLS):
        if fetch_add(counters, DONE, 0) >= count:
            return True
    return False
