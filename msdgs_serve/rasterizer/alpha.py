"""The alpha of a splat in a pixel: alpha = 2^(log2 opacity - |root @ d|²), cut to `alpha_max`, 0 below `alpha_min`."""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd.exponential import exp2, exp2_polynomial
from msdgs_serve.rasterizer.simd.types import Vector
from msdgs_serve.rasterizer.simd.vectors import filled, fma, minimum, select, spread
from msdgs_serve.rasterizer.splats import LOG2_OPACITY, ROOT_A, ROOT_B, ROOT_C, X, Y
from msdgs_serve.rasterizer.view import RasterizerOptions


class PixelLimits(NamedTuple):
    """The rasterizer options of the inner loop, in its dtype."""

    log2_alpha_min: np.floating
    alpha_max: np.floating
    transmittance_min: np.floating
    exp2: tuple  # coefficients of the polynomial that approximates 2^r


def pixel_limits(options: RasterizerOptions, dtype: np.dtype) -> PixelLimits:
    """Return `options` as scalars of `dtype`, so that a float32 loop computes in float32."""
    real = dtype.type
    polynomial = exp2_polynomial(5 if dtype == np.float32 else 12)
    return PixelLimits(
        real(np.log2(options.alpha_min)),
        real(options.alpha_max),
        real(options.transmittance_min),
        tuple(map(real, polynomial)),
    )


@kernel
def log2_alpha(
    offset_p: Vector,
    offset_q: Vector,
    a: Vector,
    b: Vector,
    c: Vector,
    log2_opacity: Vector,
    pixel_x: Vector,
    pixel_y: Vector,
) -> Vector:
    """Return log2 of the alpha of splats in pixels relative to the tile's corner; see `exponent_terms`."""
    p, q = fma(a, pixel_x, fma(b, pixel_y, offset_p)), fma(c, pixel_y, offset_q)
    return fma(-p, p, fma(-q, q, log2_opacity))


@kernel
def exponent_terms(record: np.ndarray) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector]:
    """Return the arguments of `log2_alpha` before the pixels, for one splat whose record is relative to the tile."""
    a, b, c = spread(record[ROOT_A]), spread(record[ROOT_B]), spread(record[ROOT_C])
    p, q = tile_offsets(spread(record[X]), spread(record[Y]), a, b, c)
    return p, q, a, b, c, spread(record[LOG2_OPACITY])


@kernel
def tile_offsets(x: Vector, y: Vector, a: Vector, b: Vector, c: Vector) -> tuple[Vector, Vector]:
    """Return root @ d at the tile's corner, for splats at (x, y) with the root [[a, b], [0, c]]."""
    return -fma(a, x, b * y), -(c * y)


@kernel
def alpha_of(exponent: Vector, limits: PixelLimits) -> Vector:
    """Return alpha from its log2, cut to `alpha_max` and 0 below `alpha_min`."""
    alpha = exp2(exponent, limits.exp2)
    alpha = minimum(alpha, filled(limits.alpha_max, alpha))
    return select(exponent >= limits.log2_alpha_min, alpha, filled(0, alpha))
