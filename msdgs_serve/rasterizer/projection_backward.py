"""Gradient of the projection: from splats back to means, quaternions, scales, opacities and spherical harmonics.

16 Gaussians at a time in float64, like the projection. Written for pinhole cameras without `mip`.
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.geometry import covariance2d, half_axis, project_points, rotate, rotation_columns
from msdgs_serve.rasterizer.harmonics import (
    four_coefficients,
    harmonics,
    harmonics_gradient,
    last_coefficient,
    raw_colors,
)
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.projection import part_count, part_range
from msdgs_serve.rasterizer.simd.memory import (
    load,
    load_columns,
    load_four_columns,
    load_or,
    load_triples,
    store,
    store_columns,
)
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Index, Mask, Vector
from msdgs_serve.rasterizer.simd.vectors import converted, filled, select, square_root
from msdgs_serve.rasterizer.splats import EXTENT_X, ROOT_A, ROOT_B, ROOT_C, ROOT_SCALE, Splats
from msdgs_serve.rasterizer.view import RasterizerOptions, View, view_of
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.threads import run_parallel

# indices of a record as plain ints, which numba needs to index a tuple
_A, _B, _C, _EXTENT = (int(place) for place in (ROOT_A, ROOT_B, ROOT_C, EXTENT_X))


class GaussianGradients(NamedTuple):
    """d loss / d Gaussian, 0 if it isn't drawn; the quaternion's four numbers are treated as independent."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4] wxyz
    scales: np.ndarray  # [N, 3]
    opacities: np.ndarray  # [N]
    sh: np.ndarray  # [N, (degree + 1)², 3]
    means2d: np.ndarray  # [N, 2] of the projected means, per pixel


def project_backward(
    gaussians: Gaussians, splats: Splats, sums: np.ndarray, camera: Camera, options: RasterizerOptions
) -> GaussianGradients:
    """Return gradients of the Gaussians from the sums of their splats (`composite_backward`).

    Raises `InvalidInput` for a camera that isn't pinhole and for `mip`, which have no gradients.
    """
    if camera.model != "pinhole":
        raise InvalidInput("camera.model", "pinhole for gradients", camera.model)
    if options.mip:
        raise InvalidInput("options.mip", "False for gradients", options.mip)
    count = len(gaussians)
    flat = np.empty((count, NUM_LANES), gaussians.means.dtype)
    sh = gaussians.sh.reshape(count, 3 * gaussians.sh.shape[1])
    grad_sh = np.empty_like(sh)
    g = gaussians
    arrays = (g.means, g.quats, g.scales, g.opacities, sh, splats.records, sums, flat, grad_sh)
    view = view_of(camera, options)
    parts = part_count(count)
    run_parallel(_backward_part, [(part, parts, view, *arrays) for part in range(parts)])
    means, quats, scales, opacities, means2d, _ = np.split(flat, [3, 7, 10, 11, 13], axis=1)
    return GaussianGradients(means, quats, scales, opacities[:, 0], grad_sh.reshape(gaussians.sh.shape), means2d)


@kernel
def _backward_part(
    part: int,
    parts: int,
    view: View,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
    records: np.ndarray,
    sums: np.ndarray,
    flat: np.ndarray,
    grad_sh: np.ndarray,
) -> None:
    double = np.empty(1, np.float64)
    scratch, weights = np.empty(48 * NUM_LANES, sh.dtype), np.zeros(NUM_LANES * NUM_LANES, sh.dtype)
    w, t = view.rotation, view.translation
    start, stop = part_range(part, parts, len(means))
    for first in range(start, stop, NUM_LANES):
        record, moments = load_columns(records, first), load_columns(sums, first)
        drawn = record[_EXTENT] > 0
        mean = load_triples(means, first)
        wx, wy, wz = converted(mean[0], double), converted(mean[1], double), converted(mean[2], double)
        x = w[0][0] * wx + w[0][1] * wy + w[0][2] * wz + t[0]
        y = w[1][0] * wx + w[1][1] * wy + w[1][2] * wz + t[1]
        z = w[2][0] * wx + w[2][1] * wy + w[2][2] * wz + t[2]
        _, _, jacobian = project_points(view, x, y, z)
        (j00, _, j02), (_, j11, j12) = jacobian
        qs, ss = load_four_columns(quats, first, 0), load_triples(scales, first)
        qw, qx = converted(qs[0], double), converted(qs[1], double)
        qy, qz = converted(qs[2], double), converted(qs[3], double)
        axes = rotation_columns(qw, qx, qy, qz)
        sizes = (converted(ss[0], double), converted(ss[1], double), converted(ss[2], double))
        seen = (rotate(w, axes[0]), rotate(w, axes[1]), rotate(w, axes[2]))  # in camera axes
        half = (
            half_axis(jacobian, seen[0], sizes[0]),
            half_axis(jacobian, seen[1], sizes[1]),
            half_axis(jacobian, seen[2], sizes[2]),
        )
        v_xx, v_xy, v_yy = _covariance_gradient(
            half,
            view.eps2d,
            converted(moments[6], double),
            converted(moments[7], double),
            converted(moments[8], double),
        )

        grad_u, grad_v = _mean_gradient(record, moments)
        per_z = 1 / z
        grad_x, grad_y = converted(grad_u, double) * j00, converted(grad_v, double) * j11
        grad_z = -(grad_x * x + grad_y * y) * per_z
        zero = filled(0, z)
        covariance = (v_xx, v_xy, v_yy)
        size0, axis0, jacobian0 = _axis_gradient(w, jacobian, covariance, half[0], axes[0], seen[0], sizes[0])
        size1, axis1, jacobian1 = _axis_gradient(w, jacobian, covariance, half[1], axes[1], seen[1], sizes[1])
        size2, axis2, jacobian2 = _axis_gradient(w, jacobian, covariance, half[2], axes[2], seen[2], sizes[2])
        grad_j00, grad_j02 = jacobian0[0] + jacobian1[0] + jacobian2[0], jacobian0[1] + jacobian1[1] + jacobian2[1]
        grad_j11, grad_j12 = jacobian0[2] + jacobian1[2] + jacobian2[2], jacobian0[3] + jacobian1[3] + jacobian2[3]
        # J has fx / z, -fx ratio / z, and the same for y; the ratio has a gradient only if it isn't clamped
        ratio_x, ratio_y = -j02 / j00, -j12 / j11
        grad_z += per_z * (grad_j02 * j00 * ratio_x + grad_j12 * j11 * ratio_y - grad_j00 * j00 - grad_j11 * j11)
        free_x, free_y = x * per_z, y * per_z
        grad_x_free = select((view.min_x < free_x) & (free_x < view.max_x), -grad_j02 * j00 * per_z, zero)
        grad_y_free = select((view.min_y < free_y) & (free_y < view.max_y), -grad_j12 * j11 * per_z, zero)
        grad_z += -grad_x_free * free_x - grad_y_free * free_y
        gx, gy, gz = _rotate_back(w, grad_x + grad_x_free, grad_y + grad_y_free, grad_z)
        dx, dy, dz = _color_gradient(view, sh, first, scratch, weights, drawn, wx, wy, wz, moments, grad_sh)
        grad_quat = quaternion_gradient(qw, qx, qy, qz, (axis0, axis1, axis2))
        nothing = filled(0, record[0])
        opacity = load_or(opacities, first, filled(1, nothing))
        store_columns(
            flat,
            first,
            0,
            (
                select(drawn, converted(gx + dx, flat), nothing),
                select(drawn, converted(gy + dy, flat), nothing),
                select(drawn, converted(gz + dz, flat), nothing),
                select(drawn, converted(grad_quat[0], flat), nothing),
                select(drawn, converted(grad_quat[1], flat), nothing),
                select(drawn, converted(grad_quat[2], flat), nothing),
                select(drawn, converted(grad_quat[3], flat), nothing),
                select(drawn, converted(size0, flat), nothing),
                select(drawn, converted(size1, flat), nothing),
                select(drawn, converted(size2, flat), nothing),
                select(drawn, -moments[3] / opacity, nothing),
                select(drawn, grad_u, nothing),
                select(drawn, grad_v, nothing),
            ),
        )


@kernel
def _rotate_back(w: tuple, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, Vector]:
    """Return Wᵀ times a vector."""
    return (
        w[0][0] * x + w[1][0] * y + w[2][0] * z,
        w[0][1] * x + w[1][1] * y + w[2][1] * z,
        w[0][2] * x + w[1][2] * y + w[2][2] * z,
    )


@kernel
def _axis_gradient(
    w: tuple, jacobian: tuple, covariance: tuple, half: tuple, axis: tuple, seen: tuple, size: Vector
) -> tuple:
    """Return, for one axis, d loss / d scale, / d world axis, [3], and / d (j00, j02, j11, j12), [4]."""
    v_xx, v_xy, v_yy = covariance
    (j00, _, j02), (_, j11, j12) = jacobian
    x, y = 2 * (v_xx * half[0] + v_xy * half[1]), 2 * (v_xy * half[0] + v_yy * half[1])
    a, b, c = _rotate_back(w, j00 * x, j11 * y, j02 * x + j12 * y)
    grad_size = a * axis[0] + b * axis[1] + c * axis[2]
    x, y = x * size, y * size
    return grad_size, (a * size, b * size, c * size), (x * seen[0], x * seen[2], y * seen[1], y * seen[2])


@kernel
def _covariance_gradient(
    half: tuple, eps2d: float, sum_xx: Vector, sum_xy: Vector, sum_yy: Vector
) -> tuple[Vector, Vector, Vector]:
    """Return d loss / d covariance, xx, xy, yy, by d conic = -conic @ d covariance @ conic."""
    xx, xy, yy, _, det = covariance2d(half, eps2d)
    a, b, c = yy / det, -xy / det, xx / det
    g_xx, g_xy, g_yy = 0.5 * sum_xx, 0.5 * sum_xy, 0.5 * sum_yy
    p, q = a * g_xx + b * g_xy, a * g_xy + b * g_yy
    r, s = b * g_xx + c * g_xy, b * g_xy + c * g_yy
    return -(p * a + q * b), -(p * b + q * c), -(r * b + s * c)


@kernel
def _mean_gradient(record: tuple, moments: tuple) -> tuple[Vector, Vector]:
    """Return d loss / d projected mean, with sigma = |root @ d|² / 2 and d = pixel - mean."""
    a, b = record[_A] * (1 / ROOT_SCALE), record[_B] * (1 / ROOT_SCALE)
    c = record[_C] * (1 / ROOT_SCALE)
    along = a * moments[4] + b * moments[5]
    return -a * along, -(b * along + c * c * moments[5])


@kernel
def quaternion_gradient(
    w: Vector, x: Vector, y: Vector, z: Vector, columns: tuple
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return d loss / d quaternion from the gradient of the rotation matrix, by columns."""
    (g00, g10, g20), (g01, g11, g21), (g02, g12, g22) = columns
    return (
        2 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01)),
        2 * (w * (g21 - g12) + y * (g01 + g10) + z * (g02 + g20) - 2 * x * (g11 + g22)),
        2 * (w * (g02 - g20) + x * (g01 + g10) + z * (g12 + g21) - 2 * y * (g00 + g22)),
        2 * (w * (g10 - g01) + x * (g02 + g20) + y * (g12 + g21) - 2 * z * (g00 + g11)),
    )


@kernel
def _color_gradient(
    view: View,
    sh: np.ndarray,
    first: int,
    scratch: np.ndarray,
    weights: np.ndarray,
    drawn: Mask,
    wx: Vector,
    wy: Vector,
    wz: Vector,
    moments: tuple,
    grad_sh: np.ndarray,
) -> tuple[Vector, Vector, Vector]:
    """Write the gradients of the SH coefficients, and return that of the mean through the viewing direction."""
    double = np.empty(1, np.float64)
    dx, dy, dz = wx - view.position[0], wy - view.position[1], wz - view.position[2]
    per_distance = 1 / square_root(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * per_distance, dy * per_distance, dz * per_distance
    x, y, z = converted(dx, sh), converted(dy, sh), converted(dz, sh)
    red, green, blue = raw_colors(sh, first, x, y, z)
    zero = filled(0, red)
    red = select(drawn & (red > 0), moments[0], zero)
    green = select(drawn & (green > 0), moments[1], zero)
    blue = select(drawn & (blue > 0), moments[2], zero)
    functions = sh.shape[1] // 3
    basis = harmonics(x, y, z)
    for k in range(functions):
        place = np.uint64(3 * NUM_LANES * k)
        store(scratch, place, basis[k] * red)
        store(scratch, place + np.uint64(NUM_LANES), basis[k] * green)
        store(scratch, place + np.uint64(2 * NUM_LANES), basis[k] * blue)
    weight = (red, green, blue)
    for k in range(np.uint64(0), np.uint64(functions & ~3), np.uint64(4)):
        c = four_coefficients(sh, first, k)
        for j in range(4):
            store(weights, (k + np.uint64(j)) * np.uint64(NUM_LANES), _dot(c[j], weight))
    if functions % 4:
        store(weights, np.uint64(NUM_LANES * (functions - 1)), _dot(last_coefficient(sh, first), weight))
    for window in range(0, sh.shape[1], NUM_LANES):
        store_columns(grad_sh, first, window, _sixteen(scratch, np.uint64(NUM_LANES * window)))
    gx, gy, gz = harmonics_gradient(weights, x, y, z)
    px, py, pz = converted(gx, double), converted(gy, double), converted(gz, double)
    along = px * dx + py * dy + pz * dz
    return (px - along * dx) * per_distance, (py - along * dy) * per_distance, (pz - along * dz) * per_distance


@kernel
def _dot(a: tuple, b: tuple) -> Vector:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _sixteen(scratch: np.ndarray, place: Index) -> tuple:
    """Load 16 consecutive vectors."""
    return (
        load(scratch, place),
        load(scratch, place + np.uint64(16)),
        load(scratch, place + np.uint64(32)),
        load(scratch, place + np.uint64(48)),
        load(scratch, place + np.uint64(64)),
        load(scratch, place + np.uint64(80)),
        load(scratch, place + np.uint64(96)),
        load(scratch, place + np.uint64(112)),
        load(scratch, place + np.uint64(128)),
        load(scratch, place + np.uint64(144)),
        load(scratch, place + np.uint64(160)),
        load(scratch, place + np.uint64(176)),
        load(scratch, place + np.uint64(192)),
        load(scratch, place + np.uint64(208)),
        load(scratch, place + np.uint64(224)),
        load(scratch, place + np.uint64(240)),
    )
