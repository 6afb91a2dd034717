"""exp(x) for x <= 0, written so that LLVM can put it into vector lanes; `math.exp` is a call per lane."""

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

LOG2_E = np.float32(1.4426950408889634)
LN2_HIGH = np.float32(0.693359375)  # 9 bits, so that n * LN2_HIGH is exact
LN2_LOW = np.float32(-2.12194440e-4)
LOWEST = np.float32(-60.0)  # far above the subnormal numbers, in which a product takes 100 times as long
C2, C3, C4, C5, C6 = (np.float32(1 / math.factorial(n)) for n in (2, 3, 4, 5, 6))
ONE = np.float32(1)
HALF = np.float32(0.5)


def exp_nonpositive(x: Any) -> Any:
    """exp(x), x <= 0. float32: within 2e-7 relative, and exp(-60) below -60. float64: `math.exp`."""
    return np.exp(x)


@overload(exp_nonpositive, inline="always")
def _exp_nonpositive(x: Any) -> Any:
    def float64(x: Any) -> Any:
        return math.exp(x)

    def float32(x: Any) -> Any:
        x = x if x > LOWEST else LOWEST
        n = np.floor(x * LOG2_E + HALF)
        r = x - n * LN2_HIGH - n * LN2_LOW
        poly = ONE + r * (ONE + r * (C2 + r * (C3 + r * (C4 + r * (C5 + r * C6)))))
        return poly * _power_of_two(np.int32(n))  # type: ignore[call-arg]  # numba passes the typing context

    return float64 if x == types.float64 else float32


@intrinsic
def _power_of_two(typing_context: Any, n: Any) -> Any:
    """2^n for an int32 n in [-126, 127], by writing the exponent bits of a float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        biased = builder.add(args[0], ir.Constant(ir.IntType(32), 127))
        return builder.bitcast(builder.shl(biased, ir.Constant(ir.IntType(32), 23)), ir.FloatType())

    return types.float32(types.int32), codegen
