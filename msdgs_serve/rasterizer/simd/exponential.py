"""2^x, log2 x and atan x of vectors; the C library's take a call per number."""

import math
from functools import cache

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd.types import Vector
from msdgs_serve.rasterizer.simd.vectors import exponent_of, filled, mantissa_of, rounder, select, times_power_of_two

ATANH_SERIES = tuple(2 / math.log(2) / n for n in range(21, 0, -2))
"""Coefficients of 2 atanh(s) / (s ln 2), highest power of s² first."""


ATAN_SERIES = tuple((-1) ** (n // 2) / n for n in range(37, 0, -2))
"""Coefficients of atan(s) / s, highest power of s² first; for |s| up to tan(pi / 8) the next term is 1e-16."""


@cache
def exp2_polynomial(degree: int) -> tuple[float, ...]:
    """Return coefficients, highest power first, of 1 + r p(r) ≈ 2^r: p interpolates (2^r - 1) / r at the Chebyshev
    nodes of [-1/2, 1/2], so that integer powers are exact.

    The relative error is 6e-6 for degree 4, 3e-7 for degree 5 and a few roundings of float64 for degree 12.
    """

    def slope(r: np.ndarray) -> np.ndarray:
        whole = r == 0
        return np.where(whole, math.log(2), np.expm1(r * math.log(2)) / np.where(whole, 1, r))

    interpolated = np.polynomial.Chebyshev.interpolate(slope, degree - 1, domain=[-0.5, 0.5])
    return (*interpolated.convert(kind=np.polynomial.Polynomial).coef[::-1].tolist(), 1.0)


@kernel
def exp2(x: Vector, polynomial: tuple[float, ...]) -> Vector:
    """Return 2^x if that is a normal number; the result is undefined otherwise."""
    rounded = x + rounder(x)
    r = x - (rounded - rounder(x))
    value = r * polynomial[0] + polynomial[1]
    for coefficient in polynomial[2:]:
        value = value * r + coefficient
    return times_power_of_two(value, rounded)


@kernel
def log2(x: Vector) -> Vector:
    """Return log2 of positive normal numbers, by 2 atanh((m - 1) / (m + 1)) / ln 2; within 1e-15 in float64."""
    exponent, mantissa = exponent_of(x), mantissa_of(x)
    upper = mantissa > math.sqrt(2)
    exponent = select(upper, exponent + 1, exponent)
    mantissa = select(upper, 0.5 * mantissa, mantissa)
    s = (mantissa - 1) / (mantissa + 1)
    value = filled(0, s)
    for coefficient in ATANH_SERIES:
        value = value * (s * s) + coefficient
    return exponent + s * value


@kernel
def arctangent(x: Vector) -> Vector:
    """Return atan(x) for x >= 0, within a few roundings."""
    steep = x > 1
    x = select(steep, 1 / x, x)
    upper = x > math.tan(math.pi / 8)
    s = select(upper, (x - 1) / (x + 1), x)
    value = filled(0, s)
    for coefficient in ATAN_SERIES:
        value = value * (s * s) + coefficient
    value = s * value
    value = select(upper, value + math.pi / 4, value)
    return select(steep, math.pi / 2 - value, value)
