"""Real spherical harmonics of degree 0 to 3, in the order and sign of INRIA's Gaussian splatting."""

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
