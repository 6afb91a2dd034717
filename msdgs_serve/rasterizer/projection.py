"""3D Gaussians to 2D splats: position, depth, inverse covariance, footprint and colour. Computed in float64, stored as
the Gaussians' dtype: the arithmetic is once a Gaussian, and needles and giants lose nothing to cancellation."""

import math
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.harmonics import basis_into
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.view import RasterizerOptions, View, view_of
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.threads import run_parallel, split_evenly, thread_count


class Splats(NamedTuple):
    """N projected Gaussians; where `extents` is 0 nothing is drawn and the rest is 0 too."""

    means2d: np.ndarray  # [N, 2] pixels
    depths: np.ndarray  # [N] scene units along the camera axis
    conic_roots: np.ndarray  # [N, 3] (a, b, c) of the root [[a, b], [0, c]] of the inverse 2D covariance, 1/px
    extents: np.ndarray  # [N, 2] half-size of the box outside of which alpha < alpha_min, pixels
    opacities: np.ndarray  # [N]
    colors: np.ndarray  # [N, 3] seen from the camera, >= 0


def project(gaussians: Gaussians, camera: Camera, options: RasterizerOptions) -> Splats:
    """Project N Gaussians into the camera's image."""
    count, dtype = len(gaussians), gaussians.means.dtype
    splats = Splats(
        means2d=np.zeros((count, 2), dtype),
        depths=np.zeros(count, dtype),
        conic_roots=np.zeros((count, 3), dtype),
        extents=np.zeros((count, 2), dtype),
        opacities=gaussians.opacities,
        colors=np.zeros((count, 3), dtype),
    )
    view = view_of(camera, options)
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    run_parallel(
        _project_range,
        [(start, stop, view, *arrays, splats) for start, stop in split_evenly(count, 2 * thread_count())],
    )
    return splats


@kernel
def _project_range(
    start: int,
    stop: int,
    view: View,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
    splats: Splats,
) -> None:
    basis = np.empty(sh.shape[1], np.float64)
    half_axes = np.empty((2, 3), np.float64)
    rotation = np.empty((3, 3), np.float64)
    for i in range(start, stop):
        x, y, z = to_camera(view, means, i)
        if not z > view.near_plane or not opacities[i] >= view.alpha_min:
            continue
        project_axes(view, quats, scales, i, x, y, z, rotation, half_axes)
        cov_xx, cov_xy, cov_yy, det = covariance2d(half_axes, view.eps2d)
        if not (det > 0 and det < np.inf):
            continue
        # alpha_min <= opacity exp(-sigma) bounds sigma, and the ellipse of that sigma has this bounding box
        max_sigma = math.log(float(opacities[i]) / view.alpha_min)
        extent_x = math.sqrt(2 * max_sigma * cov_xx) * 1.0001 + 1e-3
        extent_y = math.sqrt(2 * max_sigma * cov_yy) * 1.0001 + 1e-3
        u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        if u + extent_x < 0 or u - extent_x > view.width or v + extent_y < 0 or v - extent_y > view.height:
            continue
        splats.means2d[i, 0], splats.means2d[i, 1] = u, v
        splats.depths[i] = z
        # a sum of two squares, |root @ d|², keeps its digits along a needle where the quadratic form cancels
        splats.conic_roots[i, 0] = math.sqrt(cov_yy / det)
        splats.conic_roots[i, 1] = -cov_xy / math.sqrt(det * cov_yy)
        splats.conic_roots[i, 2] = 1 / math.sqrt(cov_yy)
        splats.extents[i, 0], splats.extents[i, 1] = extent_x, extent_y
        dx, dy, dz = means[i, 0] - view.position[0], means[i, 1] - view.position[1], means[i, 2] - view.position[2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        basis_into(basis, dx / distance, dy / distance, dz / distance)
        red, green, blue = raw_color(basis, sh, i)
        splats.colors[i, 0], splats.colors[i, 1], splats.colors[i, 2] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)


@kernel
def raw_color(basis: np.ndarray, sh: np.ndarray, i: int) -> tuple[float, float, float]:
    """SH + 0.5 of the i-th Gaussian, before the clamp at 0."""
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(len(basis)):
        red += basis[k] * sh[i, k, 0]
        green += basis[k] * sh[i, k, 1]
        blue += basis[k] * sh[i, k, 2]
    return red, green, blue


@kernel
def to_camera(view: View, means: np.ndarray, i: int) -> tuple[float, float, float]:
    """The i-th mean in camera axes."""
    r, t = view.rotation, view.translation
    a, b, c = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
    x = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c + t[0]
    y = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c + t[1]
    z = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c + t[2]
    return x, y, z


@kernel
def clamped(value: float, low: float, high: float) -> float:
    """`value`, cut to [low, high]."""
    return min(max(value, low), high)


@kernel
def rotation_into(rotation: np.ndarray, w: float, x: float, y: float, z: float) -> None:
    """Write the rotation matrix [3, 3] of a unit quaternion."""
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@kernel
def project_axes(
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
    j00, j02 = view.fx / z, -view.fx * clamped(x / z, view.min_x, view.max_x) / z
    j11, j12 = view.fy / z, -view.fy * clamped(y / z, view.min_y, view.max_y) / z
    rotation_into(rotation, float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3]))
    for k in range(3):
        a, b, c = rotation[0, k], rotation[1, k], rotation[2, k]
        depth = w[2, 0] * a + w[2, 1] * b + w[2, 2] * c
        half_axes[0, k] = (j00 * (w[0, 0] * a + w[0, 1] * b + w[0, 2] * c) + j02 * depth) * scales[i, k]
        half_axes[1, k] = (j11 * (w[1, 0] * a + w[1, 1] * b + w[1, 2] * c) + j12 * depth) * scales[i, k]


@kernel
def covariance2d(half_axes: np.ndarray, eps2d: float) -> tuple[float, float, float, float]:
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
