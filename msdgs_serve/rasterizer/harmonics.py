"""Spherical harmonics for the kernels: values and derivatives, degree 0 to 3."""

from typing import Any

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.vector_memory import load, load_four_columns, load_triples
from msdgs_serve.rasterizer.vector_types import Index, Vector
from msdgs_serve.rasterizer.vectors import filled, fma
from msdgs_serve.scene.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3

C20, C21, C22, C23, C24 = SH_C2
C30, C31, C32, C33, C34, C35, C36 = SH_C3


@kernel
def harmonics_above_0(x: Any, y: Any, z: Any) -> tuple:
    """The 15 basis functions of degree 1 to 3 at the unit direction (x, y, z), numbers or `Vector`."""
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
    """The 16 of degree 0 to 3; the first is a constant even where there is no direction and the others are NaN."""
    return (filled(SH_C0, x),) + harmonics_above_0(x, y, z)  # noqa: RUF005 numba unpacks no tuples


@kernel
def harmonics_slope(pulls: np.ndarray, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, Vector]:
    """The gradient in (x, y, z) of the sum of pull times basis function, 16 directions at a time.

    `pulls` has 16 `Vector` for each of the functions 0 to 15; the first is of no consequence.
    """
    xx, yy, zz = x * x, y * y, z * z
    p1, p2, p3 = load(pulls, 16), load(pulls, 32), load(pulls, 48)
    p4, p5, p6, p7, p8 = load(pulls, 64), load(pulls, 80), load(pulls, 96), load(pulls, 112), load(pulls, 128)
    p9, p10, p11, p12 = C30 * load(pulls, 144), C31 * load(pulls, 160), C32 * load(pulls, 176), C33 * load(pulls, 192)
    p13, p14, p15 = C34 * load(pulls, 208), C35 * load(pulls, 224), C36 * load(pulls, 240)
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
    """SH + 0.5 towards the unit directions (x, y, z), before the cut at 0; `sh` is [N, 3 coefficients]."""
    functions = sh.shape[1] // 3
    basis = harmonics(x, y, z)
    color = filled(0.5, x), filled(0.5, x), filled(0.5, x)
    for k in range(np.uint64(0), np.uint64(functions & ~3), np.uint64(4)):
        c = four_coefficients(sh, first, k)
        color = _added(color, c[0], basis[k])
        color = _added(color, c[1], basis[k + np.uint64(1)])
        color = _added(color, c[2], basis[k + np.uint64(2)])
        color = _added(color, c[3], basis[k + np.uint64(3)])
    if functions % 4:
        color = _added(color, last_coefficient(sh, first), basis[functions - 1])
    return color


@kernel
def _added(color: tuple, coefficient: tuple, value: Vector) -> tuple[Vector, Vector, Vector]:
    r, g, b = coefficient
    return fma(r, value, color[0]), fma(g, value, color[1]), fma(b, value, color[2])


@kernel
def four_coefficients(sh: np.ndarray, first: int, k: Index) -> tuple:
    """Of 16 Gaussians from `first` the coefficients of functions `k` to `k` + 3, red, green and blue, [4][3].

    Loaded one function at a time projecting takes 1.4 times as long.
    """
    place = np.uint64(3) * k
    a = load_four_columns(sh, first, place)
    b, c = load_four_columns(sh, first, place + np.uint64(4)), load_four_columns(sh, first, place + np.uint64(8))
    return (a[0], a[1], a[2]), (a[3], b[0], b[1]), (b[2], b[3], c[0]), (c[1], c[2], c[3])


@kernel
def last_coefficient(sh: np.ndarray, first: int) -> tuple[Vector, Vector, Vector]:
    """Of 16 Gaussians from `first` the coefficient of the last function, red, green and blue."""
    if sh.shape[1] == 3:
        return load_triples(sh, first)
    _, r, g, b = load_four_columns(sh, first, sh.shape[1] - 4)
    return r, g, b
