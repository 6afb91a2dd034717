"""A counter that several threads of compiled kernels draw numbers from."""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import lower_builtin, type_callable


def fetch_add(counter: np.ndarray, amount: int) -> int:
    """Add to the int64 `counter` [1]; returns what it was. Without the compiler not safe from several threads."""
    before = int(counter[0])
    counter[0] += amount
    return before


@type_callable(fetch_add)
def _type_fetch_add(_context: Any) -> Callable:
    return lambda counter, amount: types.int64


@lower_builtin(fetch_add, types.Array, types.Integer)
def _lower_fetch_add(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    amount = context.cast(builder, values[1], signature.args[1], types.int64)
    return builder.atomic_rmw("add", builder.bitcast(data, ir.IntType(64).as_pointer()), amount, "monotonic")
