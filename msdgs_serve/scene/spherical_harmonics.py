"""Real spherical harmonics of degree 0 to 3, in the order and sign of INRIA's Gaussian splatting."""

import numpy as np

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
"""Degree for each number of coefficients per color channel."""


def sh_coefficients(degree: int) -> int:
    """Return the number of coefficients per color channel up to and including `degree`."""
    return (degree + 1) ** 2


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return basis functions, shape (*, (degree + 1)²), at unit directions from eye to Gaussian, shape (*, 3)."""
    x, y, z = np.moveaxis(np.asarray(directions), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    basis = [np.full_like(x, SH_C0)]
    if degree >= 1:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        basis += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * zz - xx - yy),
            SH_C2[3] * x * z,
            SH_C2[4] * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            SH_C3[0] * y * (3 * xx - yy),
            SH_C3[1] * x * y * z,
            SH_C3[2] * y * (4 * zz - xx - yy),
            SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            SH_C3[4] * x * (4 * zz - xx - yy),
            SH_C3[5] * z * (xx - yy),
            SH_C3[6] * x * (xx - 3 * yy),
        ]
    return np.stack(basis, axis=-1)


def sh_to_rgb(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return colors, shape (*, 3), of coefficients, shape (*, (degree + 1)², 3), in unit directions, shape (*, 3)."""
    basis = sh_basis(directions, SH_DEGREES[sh.shape[-2]])
    return np.maximum(np.einsum("...k,...kc->...c", basis, sh) + 0.5, 0)


def rgb_to_sh_dc(rgb: np.ndarray) -> np.ndarray:
    """Return the degree-0 coefficient that gives `rgb` in every direction."""
    return (np.asarray(rgb) - 0.5) / SH_C0
