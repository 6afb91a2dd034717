"""Spherical harmonics of one direction for the kernels: values and derivatives, degree 0 to 3."""

from typing import Any

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.scene.spherical_harmonics import SH_C1, SH_C2, SH_C3

C20, C21, C22, C23, C24 = SH_C2
C30, C31, C32, C33, C34, C35, C36 = SH_C3


@kernel
def harmonics_above_0(x: Any, y: Any, z: Any) -> tuple:
    """The 15 basis functions of degree 1 to 3 at the unit direction (x, y, z), numbers or `Lanes`."""
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
def basis_gradient_into(gradient: np.ndarray, x: float, y: float, z: float) -> None:
    """Write d basis / d (x, y, z) into `gradient` [coefficients, 3]."""
    gradient[:] = 0
    n = len(gradient)
    if n > 1:
        gradient[1, 1] = -SH_C1
        gradient[2, 2] = SH_C1
        gradient[3, 0] = -SH_C1
    xx, yy, zz = x * x, y * y, z * z
    if n > 4:
        _set(gradient, 4, C20 * y, C20 * x, 0.0)
        _set(gradient, 5, 0.0, C21 * z, C21 * y)
        _set(gradient, 6, -2 * C22 * x, -2 * C22 * y, 4 * C22 * z)
        _set(gradient, 7, C23 * z, 0.0, C23 * x)
        _set(gradient, 8, 2 * C24 * x, -2 * C24 * y, 0.0)
    if n > 9:
        _set(gradient, 9, 6 * C30 * x * y, 3 * C30 * (xx - yy), 0.0)
        _set(gradient, 10, C31 * y * z, C31 * x * z, C31 * x * y)
        _set(gradient, 11, -2 * C32 * x * y, C32 * (4 * zz - xx - 3 * yy), 8 * C32 * y * z)
        _set(gradient, 12, -6 * C33 * x * z, -6 * C33 * y * z, C33 * (6 * zz - 3 * xx - 3 * yy))
        _set(gradient, 13, C34 * (4 * zz - 3 * xx - yy), -2 * C34 * x * y, 8 * C34 * x * z)
        _set(gradient, 14, 2 * C35 * x * z, -2 * C35 * y * z, C35 * (xx - yy))
        _set(gradient, 15, 3 * C36 * (xx - yy), -6 * C36 * x * y, 0.0)


@kernel
def _set(gradient: np.ndarray, k: int, dx: float, dy: float, dz: float) -> None:
    gradient[k, 0] = dx
    gradient[k, 1] = dy
    gradient[k, 2] = dz
