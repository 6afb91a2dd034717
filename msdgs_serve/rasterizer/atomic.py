"""Counters that several threads of compiled kernels take their work from."""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import lower_builtin, type_callable

from msdgs_serve.rasterizer.jit import kernel

TAKEN, DONE = range(2)
"""Of the counters [2] of a piece of work: how many of its parts are taken, and how many of these are done."""
MAX_POLLS = 5000
"""Looks at what others do, 0.03 ms and more; a thread that sleeps takes twice as long to wake up."""


def fetch_add(counters: np.ndarray, place: int, amount: int) -> int:
    """Add to an int64 of `counters`; returns what it was. Without the compiler not safe from several threads."""
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
    """Whether `count` parts are done, perhaps by other threads, now or in a moment."""
    for _ in range(MAX_POLLS):
        if fetch_add(counters, DONE, 0) >= count:
            return True
    return False
