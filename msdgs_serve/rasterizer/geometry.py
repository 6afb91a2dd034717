"""Rotations, camera models and 2D covariances of the projection, 16 Gaussians at a time."""

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.simd.exponential import arctangent
from msdgs_serve.rasterizer.simd.types import Vector
from msdgs_serve.rasterizer.simd.vectors import converted, filled, maximum, minimum, spread, square_root
from msdgs_serve.rasterizer.view import FISHEYE, ORTHOGRAPHIC, View


@kernel
def rotation_columns(w: Vector, x: Vector, y: Vector, z: Vector) -> tuple:
    """Return the columns of the rotation matrices of unit quaternions, [3][3]."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@kernel
def rotate(rotation: tuple, vector: tuple) -> tuple[Vector, Vector, Vector]:
    """Return a matrix [3, 3] times a vector [3]."""
    a, b, c = vector
    return (
        rotation[0][0] * a + rotation[0][1] * b + rotation[0][2] * c,
        rotation[1][0] * a + rotation[1][1] * b + rotation[1][2] * c,
        rotation[2][0] * a + rotation[2][1] * b + rotation[2][2] * c,
    )


@kernel
def half_axis(jacobian: tuple, axis: tuple, size: Vector) -> tuple[Vector, Vector]:
    """Return the image of an axis of an ellipsoid: J @ axis * size, x and y."""
    x, y, z = axis
    (xx, xy, xz), (yx, yy, yz) = jacobian
    return (xx * x + xy * y + xz * z) * size, (yx * x + yy * y + yz * z) * size


@kernel
def covariance2d(half: tuple, eps2d: float) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Return xx, xy, yy of M Mᵀ + eps I for half-axes M, [3][2], and its determinants without and with eps I.

    The determinants are sums of squares (Cauchy-Binet), so that needles of 1e6 : 1 lose no digits to cancellation.
    """
    (mx0, my0), (mx1, my1), (mx2, my2) = half
    xx, yy = mx0 * mx0 + mx1 * mx1 + mx2 * mx2, my0 * my0 + my1 * my1 + my2 * my2
    xy = mx0 * my0 + mx1 * my1 + mx2 * my2
    d0, d1, d2 = mx1 * my2 - mx2 * my1, mx2 * my0 - mx0 * my2, mx0 * my1 - mx1 * my0
    sharp = d0 * d0 + d1 * d1 + d2 * d2
    return xx + eps2d, xy, yy + eps2d, sharp, sharp + eps2d * (xx + yy) + eps2d * eps2d


@inlined_kernel
def project_points(view: View, x: Vector, y: Vector, z: Vector) -> tuple:
    """Project points in camera axes. Return u and v in pixels and the Jacobian, [2][3]."""
    zero = filled(0, z)
    if view.model == ORTHOGRAPHIC:
        u, v = view.fx * x, view.fy * y
        jacobian = ((filled(view.fx, z), zero, zero), (zero, filled(view.fy, z), zero))
    elif view.model == FISHEYE:
        # slightly off the axis, to avoid a division by 0 on it
        square = x * x + y * y + 1e-20 * z * z
        radius = square_root(square)
        theta = arctangent(radius / z)
        tt = theta * theta
        k = view.distortion
        rho = theta * (1 + tt * (k[0] + tt * (k[1] + tt * (k[2] + tt * k[3]))))
        growth = 1 + tt * (3 * k[0] + tt * (5 * k[1] + tt * (7 * k[2] + tt * (9 * k[3]))))
        u, v = view.fx * rho * x / radius, view.fy * rho * y / radius
        per_distance = growth / (square + z * z)
        radial, tangential = z * per_distance / square, rho / (radius * square)
        mixed = x * y * (radial - tangential)
        xx = x * x * radial + (square - x * x) * tangential
        yy = y * y * radial + (square - y * y) * tangential
        jacobian = (
            (view.fx * xx, view.fx * mixed, -view.fx * x * per_distance),
            (view.fy * mixed, view.fy * yy, -view.fy * y * per_distance),
        )
    else:
        per_z = 1 / z
        ratio_x, ratio_y = x * per_z, y * per_z
        u, v = view.fx * ratio_x, view.fy * ratio_y
        xx, yy = view.fx * per_z, view.fy * per_z
        xz = -xx * maximum(minimum(ratio_x, filled(view.max_x, z)), filled(view.min_x, z))
        yz = -yy * maximum(minimum(ratio_y, filled(view.max_y, z)), filled(view.min_y, z))
        jacobian = ((xx, zero, xz), (zero, yy, yz))
    return u + view.cx, v + view.cy, jacobian


@kernel
def direction(
    view: View, x: Vector, y: Vector, z: Vector, depth: Vector, like: np.ndarray
) -> tuple[Vector, Vector, Vector]:
    """Return the unit viewing directions to points in the world, in the dtype of `like`."""
    if view.model == ORTHOGRAPHIC:
        r = view.rotation
        return spread(like.dtype.type(r[2][0])), spread(like.dtype.type(r[2][1])), spread(like.dtype.type(r[2][2]))
    # divided by the depth before squaring: the square of a distance may overflow float32
    per_depth, position = 1 / depth, view.position
    dx = converted((x - position[0]) * per_depth, like)
    dy = converted((y - position[1]) * per_depth, like)
    dz = converted((z - position[2]) * per_depth, like)
    per_distance = 1 / square_root(dx * dx + dy * dy + dz * dz)
    return dx * per_distance, dy * per_distance, dz * per_distance
