"""Spherical harmonics of degree 0 to 3 for the kernels: values, derivatives and colors."""

from typing import Any

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.simd.memory import load, load_four_columns, load_triples
from msdgs_serve.rasterizer.simd.types import Index, Vector
from msdgs_serve.rasterizer.simd.vectors import filled, fma
from msdgs_serve.scene.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3

C20, C21, C22, C23, C24 = SH_C2
C30, C31, C32, C33, C34, C35, C36 = SH_C3


@kernel
def harmonics_above_0(x: Any, y: Any, z: Any) -> tuple:
    """Return the 15 basis functions of degree 1 to 3 at unit directions (x, y, z), numbers or vectors."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        -SH_C1 * y,
        SH_C1 * z,
        -SH_C1 * x,
        C20 * x * y,
        C21 * y * z,
        C22 * (2 * zz - xx - yy),
        C23 * x * z,
        C24 * (xx - yy),
        C30 * y * (3 * xx - yy),
        C31 * x * y * z,
        C32 * y * (4 * zz - xx - yy),
        C33 * z * (2 * zz - 3 * xx - 3 * yy),
        C34 * x * (4 * zz - xx - yy),
        C35 * z * (xx - yy),
        C36 * x * (xx - 3 * yy),
    )


@kernel
def harmonics(x: Vector, y: Vector, z: Vector) -> tuple:
    """Return the 16 basis functions of degree 0 to 3; the first is constant even if the direction is NaN."""
    return (filled(SH_C0, x),) + harmonics_above_0(x, y, z)  # noqa: RUF005 numba unpacks no tuples


@kernel
def harmonics_gradient(weights: np.ndarray, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the gradient in (x, y, z) of the sum of weight times basis function, for 16 directions at a time.

    `weights` [16 × 16] has one vector for each basis function; the first has no effect.
    """
    xx, yy, zz = x * x, y * y, z * z
    p1, p2, p3 = load(weights, 16), load(weights, 32), load(weights, 48)
    p4, p5, p6, p7, p8 = load(weights, 64), load(weights, 80), load(weights, 96), load(weights, 112), load(weights, 128)
    p9, p10, p11, p12 = (
        C30 * load(weights, 144),
        C31 * load(weights, 160),
        C32 * load(weights, 176),
        C33 * load(weights, 192),
    )
    p13, p14, p15 = C34 * load(weights, 208), C35 * load(weights, 224), C36 * load(weights, 240)
    dx = -SH_C1 * p3 + C20 * y * p4 - 2 * C22 * x * p6 + C23 * z * p7 + 2 * C24 * x * p8
    dx += 6 * x * y * p9 + y * z * p10 - 2 * x * y * p11 - 6 * x * z * p12
    dx += (4 * zz - 3 * xx - yy) * p13 + 2 * x * z * p14 + 3 * (xx - yy) * p15
    dy = -SH_C1 * p1 + C20 * x * p4 + C21 * z * p5 - 2 * C22 * y * p6 - 2 * C24 * y * p8
    dy += 3 * (xx - yy) * p9 + x * z * p10 + (4 * zz - xx - 3 * yy) * p11 - 6 * y * z * p12
    dy += -2 * x * y * p13 - 2 * y * z * p14 - 6 * x * y * p15
    dz = SH_C1 * p2 + C21 * y * p5 + 4 * C22 * z * p6 + C23 * x * p7
    dz += x * y * p10 + 8 * y * z * p11 + (6 * zz - 3 * xx - 3 * yy) * p12 + 8 * x * z * p13 + (xx - yy) * p14
    return dx, dy, dz


@inlined_kernel
def raw_colors(sh: np.ndarray, first: int, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, Vector]:
    """Return SH + 0.5 in unit directions (x, y, z), before clamping at 0; `sh` is [N, 3 × coefficients].

    A loop over groups of four, which calls `four_coefficients`, makes the projection take 1.4 times as long.
    """
    functions = sh.shape[1] // 3
    basis = harmonics(x, y, z)
    color = filled(0.5, x), filled(0.5, x), filled(0.5, x)
    if functions >= 4:
        color = _added_four(color, sh, first, np.uint64(0), basis[:4])
    if functions >= 9:
        color = _added_four(color, sh, first, np.uint64(4), basis[4:8])
    if functions >= 16:
        color = _added_four(color, sh, first, np.uint64(8), basis[8:12])
        color = _added_four(color, sh, first, np.uint64(12), basis[12:])
    if functions % 4:
        color = _added(color, last_coefficient(sh, first), basis[0] if functions == 1 else basis[8])
    return color


@inlined_kernel
def _added_four(color: tuple, sh: np.ndarray, first: int, k: Index, values: tuple) -> tuple[Vector, Vector, Vector]:
    c = four_coefficients(sh, first, k)
    color = _added(_added(color, c[0], values[0]), c[1], values[1])
    return _added(_added(color, c[2], values[2]), c[3], values[3])


@inlined_kernel
def _added(color: tuple, coefficient: tuple, value: Vector) -> tuple[Vector, Vector, Vector]:
    r, g, b = coefficient
    return fma(r, value, color[0]), fma(g, value, color[1]), fma(b, value, color[2])


@inlined_kernel
def four_coefficients(sh: np.ndarray, first: int, k: Index) -> tuple:
    """Return red, green and blue coefficients of basis functions `k` to `k` + 3 of 16 Gaussians from `first`, [4][3].

    Loading one function at a time makes the projection take 1.4 times as long.
    """
    place = np.uint64(3) * k
    a = load_four_columns(sh, first, place)
    b, c = load_four_columns(sh, first, place + np.uint64(4)), load_four_columns(sh, first, place + np.uint64(8))
    return (a[0], a[1], a[2]), (a[3], b[0], b[1]), (b[2], b[3], c[0]), (c[1], c[2], c[3])


@inlined_kernel
def last_coefficient(sh: np.ndarray, first: int) -> tuple[Vector, Vector, Vector]:
    """Return red, green and blue coefficients of the last basis function of 16 Gaussians from `first`."""
    if sh.shape[1] == 3:
        return load_triples(sh, first)
    _, r, g, b = load_four_columns(sh, first, sh.shape[1] - 4)
    return r, g, b
