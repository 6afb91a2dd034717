"""Gradient of the projection: from splats back to means, quaternions, scales and spherical harmonics."""

import math
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.compositing_backward import SplatGradients
from msdgs_serve.rasterizer.harmonics import basis_gradient_into, harmonics_above_0
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.projection import EXTENT_X, Splats
from msdgs_serve.rasterizer.view import RasterizerOptions, View, view_of
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_serve.threads import run_parallel, split_evenly, thread_count


class GaussianGradients(NamedTuple):
    """d loss / d Gaussian; of the quaternion, as if its four numbers were free."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4] wxyz
    scales: np.ndarray  # [N, 3]
    sh: np.ndarray  # [N, (degree + 1)², 3]


def project_backward(
    gaussians: Gaussians, splats: Splats, gradients: SplatGradients, camera: Camera, options: RasterizerOptions
) -> GaussianGradients:
    """Gradients of the Gaussians from the gradients of their splats.

    Raises `InvalidInput` for a camera that isn't pinhole and for `mip`: they are drawn, not trained with.
    """
    if camera.model != "pinhole":
        raise InvalidInput("camera.model", "pinhole for gradients", camera.model)
    if options.mip:
        raise InvalidInput("options.mip", "False for gradients", options.mip)
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh)
    result = GaussianGradients(*(np.zeros_like(array) for array in arrays))
    view = view_of(camera, options)
    run_parallel(
        _backward_range,
        [
            (start, stop, view, *arrays, splats.records, gradients, result)
            for start, stop in split_evenly(len(gaussians), 2 * thread_count())
        ],
    )
    return result


@kernel
def _backward_range(
    start: int,
    stop: int,
    view: View,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    sh: np.ndarray,
    records: np.ndarray,
    gradients: SplatGradients,
    result: GaussianGradients,
) -> None:
    rotation = np.empty((3, 3), np.float64)
    grad_rotation = np.empty((3, 3), np.float64)
    half_axes = np.empty((2, 3), np.float64)
    grad_axes = np.empty((2, 3), np.float64)
    grad_camera = np.empty(3, np.float64)
    grad_world = np.empty(3, np.float64)
    basis = np.empty(sh.shape[1], np.float64)
    basis_gradient = np.empty((sh.shape[1], 3), np.float64)
    for i in range(start, stop):
        if records[i, EXTENT_X] == 0:
            continue
        x, y, z = _to_camera(view, means, i)
        _project_axes(view, quats, scales, i, x, y, z, rotation, half_axes)
        _axes_gradient(view, half_axes, gradients.conics, i, grad_axes)
        grad_u, grad_v = float(gradients.means2d[i, 0]), float(gradients.means2d[i, 1])
        grad_camera[0] = grad_u * view.fx / z
        grad_camera[1] = grad_v * view.fy / z
        grad_camera[2] = -(grad_u * view.fx * x + grad_v * view.fy * y) / (z * z)
        _shape_gradient(view, scales, i, x, y, z, rotation, grad_axes, grad_rotation, grad_camera, result)
        _quaternion_gradient(quats, i, grad_rotation, result.quats)
        _color_gradient(view, means, sh, gradients.colors, i, basis, basis_gradient, grad_world, result.sh)
        for k in range(3):
            for j in range(3):
                grad_world[k] += view.rotation[j, k] * grad_camera[j]
            result.means[i, k] = grad_world[k]


@kernel
def _axes_gradient(view: View, half_axes: np.ndarray, grad_conics: np.ndarray, i: int, grad_axes: np.ndarray) -> None:
    """Write d loss / d half-axes: the covariance is M Mᵀ + eps I and d conic = -conic d covariance conic."""
    cov_xx, cov_xy, cov_yy, det = _covariance2d(half_axes, view.eps2d)
    a, b, c = cov_yy / det, -cov_xy / det, cov_xx / det
    g_xx, g_xy, g_yy = float(grad_conics[i, 0]), 0.5 * float(grad_conics[i, 1]), float(grad_conics[i, 2])
    # G = -conic grad conic, symmetric
    p, q = a * g_xx + b * g_xy, a * g_xy + b * g_yy
    r, s = b * g_xx + c * g_xy, b * g_xy + c * g_yy
    v_xx, v_xy, v_yy = -(p * a + q * b), -(p * b + q * c), -(r * b + s * c)
    for k in range(3):
        grad_axes[0, k] = 2 * (v_xx * half_axes[0, k] + v_xy * half_axes[1, k])
        grad_axes[1, k] = 2 * (v_xy * half_axes[0, k] + v_yy * half_axes[1, k])


@kernel
def _shape_gradient(
    view: View,
    scales: np.ndarray,
    i: int,
    x: float,
    y: float,
    z: float,
    rotation: np.ndarray,
    grad_axes: np.ndarray,
    grad_rotation: np.ndarray,
    grad_camera: np.ndarray,
    result: GaussianGradients,
) -> None:
    """Scales, rotation matrix (into `grad_rotation`) and, through the Jacobian, the mean in camera axes (added)."""
    w = view.rotation
    ratio_x, ratio_y = _clamped(x / z, view.min_x, view.max_x), _clamped(y / z, view.min_y, view.max_y)
    j00, j02, j11, j12 = view.fx / z, -view.fx * ratio_x / z, view.fy / z, -view.fy * ratio_y / z
    grad_j00, grad_j02, grad_j11, grad_j12 = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        scale = float(scales[i, k])
        grad_scale = 0.0
        g0, g1 = grad_axes[0, k], grad_axes[1, k]
        for j in range(3):
            to_image = g0 * (j00 * w[0, j] + j02 * w[2, j]) + g1 * (j11 * w[1, j] + j12 * w[2, j])
            grad_scale += to_image * rotation[j, k]
            grad_rotation[j, k] = to_image * scale
        result.scales[i, k] = grad_scale
        a, b, c = rotation[0, k] * scale, rotation[1, k] * scale, rotation[2, k] * scale
        axis_x = w[0, 0] * a + w[0, 1] * b + w[0, 2] * c
        axis_y = w[1, 0] * a + w[1, 1] * b + w[1, 2] * c
        axis_z = w[2, 0] * a + w[2, 1] * b + w[2, 2] * c
        grad_j00 += g0 * axis_x
        grad_j02 += g0 * axis_z
        grad_j11 += g1 * axis_y
        grad_j12 += g1 * axis_z
    zz = z * z
    grad_camera[2] -= (grad_j00 * view.fx + grad_j11 * view.fy) / zz
    grad_camera[2] += (grad_j02 * view.fx * ratio_x + grad_j12 * view.fy * ratio_y) / zz
    if view.min_x < x / z < view.max_x:
        grad_camera[0] -= grad_j02 * view.fx / zz
        grad_camera[2] += grad_j02 * view.fx * x / (zz * z)
    if view.min_y < y / z < view.max_y:
        grad_camera[1] -= grad_j12 * view.fy / zz
        grad_camera[2] += grad_j12 * view.fy * y / (zz * z)


@kernel
def _quaternion_gradient(quats: np.ndarray, i: int, g: np.ndarray, grad_quats: np.ndarray) -> None:
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    grad_quats[i, 0] = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    grad_quats[i, 1] = 2 * (
        w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2 * x * (g[1, 1] + g[2, 2])
    )
    grad_quats[i, 2] = 2 * (
        w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2 * y * (g[0, 0] + g[2, 2])
    )
    grad_quats[i, 3] = 2 * (
        w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2 * z * (g[0, 0] + g[1, 1])
    )


@kernel
def _color_gradient(
    view: View,
    means: np.ndarray,
    sh: np.ndarray,
    grad_colors: np.ndarray,
    i: int,
    basis: np.ndarray,
    basis_gradient: np.ndarray,
    grad_world: np.ndarray,
    grad_sh: np.ndarray,
) -> None:
    """Coefficients, and the mean through the viewing direction (written to `grad_world`)."""
    dx, dy, dz = means[i, 0] - view.position[0], means[i, 1] - view.position[1], means[i, 2] - view.position[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / distance, dy / distance, dz / distance
    _basis_into(basis, dx, dy, dz)
    basis_gradient_into(basis_gradient, dx, dy, dz)
    red, green, blue = _raw_color(basis, sh, i)
    grad_red = grad_colors[i, 0] if red > 0 else 0.0
    grad_green = grad_colors[i, 1] if green > 0 else 0.0
    grad_blue = grad_colors[i, 2] if blue > 0 else 0.0
    gx, gy, gz = 0.0, 0.0, 0.0
    for k in range(len(basis)):
        grad_sh[i, k, 0] = basis[k] * grad_red
        grad_sh[i, k, 1] = basis[k] * grad_green
        grad_sh[i, k, 2] = basis[k] * grad_blue
        pull = sh[i, k, 0] * grad_red + sh[i, k, 1] * grad_green + sh[i, k, 2] * grad_blue
        gx += pull * basis_gradient[k, 0]
        gy += pull * basis_gradient[k, 1]
        gz += pull * basis_gradient[k, 2]
    along = gx * dx + gy * dy + gz * dz
    grad_world[0] = (gx - along * dx) / distance
    grad_world[1] = (gy - along * dy) / distance
    grad_world[2] = (gz - along * dz) / distance


@kernel
def _basis_into(basis: np.ndarray, x: float, y: float, z: float) -> None:
    """Write as many basis functions as `basis` [1, 4, 9 or 16] has places, at the unit direction (x, y, z)."""
    above = harmonics_above_0(x, y, z)
    basis[0] = SH_C0
    for k in range(1, len(basis)):
        basis[k] = above[k - 1]


@kernel
def _raw_color(basis: np.ndarray, sh: np.ndarray, i: int) -> tuple[float, float, float]:
    """SH + 0.5 of the i-th Gaussian, before the clamp at 0."""
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(len(basis)):
        red += basis[k] * sh[i, k, 0]
        green += basis[k] * sh[i, k, 1]
        blue += basis[k] * sh[i, k, 2]
    return red, green, blue


@kernel
def _to_camera(view: View, means: np.ndarray, i: int) -> tuple[float, float, float]:
    """The i-th mean in camera axes."""
    r, t = view.rotation, view.translation
    a, b, c = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
    x = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c + t[0]
    y = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c + t[1]
    z = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c + t[2]
    return x, y, z


@kernel
def _clamped(value: float, low: float, high: float) -> float:
    """`value`, cut to [low, high]."""
    return min(max(value, low), high)


@kernel
def _rotation_into(rotation: np.ndarray, w: float, x: float, y: float, z: float) -> None:
    """Write the rotation matrix [3, 3] of a unit quaternion."""
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@kernel
def _project_axes(
    view: View,
    quats: np.ndarray,
    scales: np.ndarray,
    i: int,
    x: float,
    y: float,
    z: float,
    rotation: np.ndarray,
    half_axes: np.ndarray,
) -> None:
    """Write R [3, 3] and J W R S [2, 3]: the three half-axes of Gaussian i as vectors in the image, pixels."""
    w = view.rotation
    j00, j02 = view.fx / z, -view.fx * _clamped(x / z, view.min_x, view.max_x) / z
    j11, j12 = view.fy / z, -view.fy * _clamped(y / z, view.min_y, view.max_y) / z
    _rotation_into(rotation, float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3]))
    for k in range(3):
        a, b, c = rotation[0, k], rotation[1, k], rotation[2, k]
        depth = w[2, 0] * a + w[2, 1] * b + w[2, 2] * c
        half_axes[0, k] = (j00 * (w[0, 0] * a + w[0, 1] * b + w[0, 2] * c) + j02 * depth) * scales[i, k]
        half_axes[1, k] = (j11 * (w[1, 0] * a + w[1, 1] * b + w[1, 2] * c) + j12 * depth) * scales[i, k]


@kernel
def _covariance2d(half_axes: np.ndarray, eps2d: float) -> tuple[float, float, float, float]:
    """xx, xy, yy and determinant of M Mᵀ + eps2d I for half-axes M [2, 3].

    The determinant is a sum of squares (Cauchy-Binet), so that a needle of 1e6 : 1 keeps its digits.
    """
    m = half_axes
    xx = m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2]
    xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1] + m[0, 2] * m[1, 2]
    yy = m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1] + m[1, 2] * m[1, 2]
    a = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    b = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
    c = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    return xx + eps2d, xy, yy + eps2d, a * a + b * b + c * c + eps2d * (xx + yy) + eps2d * eps2d
