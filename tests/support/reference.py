"""A slow, obvious float64 renderer: one loop over the Gaussians, front to back, without culling or tiles.

It shares no code with the package: rotations, harmonics, projection and blending follow the paper (equations 1 and 2)
and the constants in `RasterizerOptions`.

The image is discontinuous at thresholds, where float32 may decide differently: alpha at `alpha_min`, the end of the
transmittance, the order of almost equal depths. Such pixels are detected, and `slack` bounds the change of the weights
of a pixel.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Legendre

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene import Camera, Gaussians

ALPHA_BAND = 1e-3
"""Relative distance to a threshold within which float32 may be on its other side: sigma, about 5.5 at the threshold,
has an error of a pixel coordinate (3e-5 px) times its slope (6 / px), about 2e-4."""

DEPTH_BAND = 2e-6
"""Relative distance of two depths within which float32 may swap them: some roundings of 6e-8, times |position| / z."""


class Reference(NamedTuple):
    rgb: np.ndarray  # [H, W, 3] background included
    alpha: np.ndarray  # [H, W]
    depth: np.ndarray  # [H, W] mean distance along the camera axis, inf where alpha is 0
    slack: np.ndarray  # [H, W] bound on what decisions at a threshold change in a pixel's weights; 0 almost everywhere
    color_range: float  # largest difference between two colors in the scene, background included


class Splat(NamedTuple):
    mean: np.ndarray  # [2] pixels
    inverse_covariance: np.ndarray  # [2, 2] 1/pixels²
    depth: float
    color: np.ndarray  # [3]
    opacity: float


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: tuple[float, float, float] | np.ndarray = (0.0, 0.0, 0.0),
    options: RasterizerOptions = GSPLAT,
    depth_band: float = DEPTH_BAND,
) -> Reference:
    """Equation 2 at every pixel. Set `depth_band` to 0 where depths are exact, to decide ties as well."""
    background = np.asarray(background, float)
    colors = view_colors(gaussians, camera)
    projected = [project(gaussians, k, camera, colors[k], options) for k in range(len(gaussians))]
    splats = [s for s in projected if s is not None]
    splats.sort(key=lambda s: np.float32(s.depth))  # stable: equal depths stay in the order of the Gaussians

    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rgb = np.zeros((camera.height, camera.width, 3))
    weighted_depth, total = np.zeros_like(x), np.zeros_like(x)
    transmittance, doubt = np.ones_like(x), np.full_like(x, ALPHA_BAND)  # doubt: relative error of the transmittance
    stopped = np.zeros(x.shape, bool)
    slack, last_depth, before_last = np.zeros_like(x), np.full_like(x, -np.inf), np.ones_like(x)

    for splat in splats:
        dx, dy = x - splat.mean[0], y - splat.mean[1]
        (a, b), (_, c) = splat.inverse_covariance
        raw_alpha = splat.opacity * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        alpha = np.minimum(options.alpha_max, raw_alpha)
        drawn = (alpha >= options.alpha_min) & ~stopped
        after = transmittance * (1 - alpha)
        stops = drawn & (after <= options.transmittance_min)

        at_threshold = ~stopped & (np.abs(raw_alpha / options.alpha_min - 1) < ALPHA_BAND)
        at_stop = drawn & (np.abs(after / options.transmittance_min - 1) < doubt)
        at_tie = drawn & (splat.depth - last_depth < depth_band * splat.depth)
        slack += transmittance * (at_threshold * options.alpha_min + at_stop) + before_last * at_tie * alpha
        doubt += np.where(drawn, ALPHA_BAND * 1e-2 * alpha / (1 - alpha), 0.0)
        doubt += np.where(at_threshold, 2 * options.alpha_min, 0.0)

        stopped |= stops
        blended = drawn & ~stops
        weight = np.where(blended, alpha * transmittance, 0.0)
        rgb += weight[..., None] * splat.color
        weighted_depth += weight * splat.depth
        total += weight
        before_last = np.where(blended, transmittance, before_last)
        transmittance = np.where(blended, after, transmittance)
        last_depth = np.where(blended, splat.depth, last_depth)

    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(total > 0, weighted_depth / total, np.inf)
    rgb += transmittance[..., None] * background
    palette = np.array([s.color for s in splats] + [background])
    return Reference(rgb, 1 - transmittance, depth, slack, float(np.ptp(palette, axis=0).max()))


def project(
    gaussians: Gaussians, k: int, camera: Camera, color: np.ndarray, options: RasterizerOptions = GSPLAT
) -> Splat | None:
    """Equation 1: Gaussian `k` as an ellipse in the image, or None where it is culled."""
    world_to_camera = np.linalg.inv(camera.camera_to_world)
    mean_world = gaussians.means[k].astype(float)
    rotation = world_to_camera[:3, :3]
    x, y, z = rotation @ mean_world + world_to_camera[:3, 3]
    if z <= options.near_plane:
        return None

    tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    slope_x = np.clip(x / z, -camera.cx / camera.fx - 0.3 * tan_x, (camera.width - camera.cx) / camera.fx + 0.3 * tan_x)
    slope_y = np.clip(
        y / z, -camera.cy / camera.fy - 0.3 * tan_y, (camera.height - camera.cy) / camera.fy + 0.3 * tan_y
    )
    jacobian = np.array([[camera.fx / z, 0, -camera.fx * slope_x / z], [0, camera.fy / z, -camera.fy * slope_y / z]])

    axes = quaternion_matrix(gaussians.quats[k].astype(float)) * gaussians.scales[k].astype(float)  # R S
    half = jacobian @ rotation @ axes
    covariance = half @ half.T + options.eps2d * np.eye(2)
    if np.linalg.det(covariance) <= 0:
        return None

    mean = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    return Splat(mean, np.linalg.inv(covariance), z, color, float(gaussians.opacities[k]))


def view_colors(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """[N, 3] harmonics along the line from the eye to each mean, plus 0.5, not below 0."""
    lines = gaussians.means.astype(float) - camera.camera_to_world[:3, 3]
    lengths = np.linalg.norm(lines, axis=1, keepdims=True)
    directions = np.divide(lines, lengths, out=np.zeros_like(lines), where=lengths > 0)
    basis = sh_basis(directions, math.isqrt(gaussians.sh.shape[1]) - 1)
    return np.maximum(np.einsum("nk,nkc->nc", basis, gaussians.sh.astype(float)) + 0.5, 0)


def quaternion_matrix(quat: np.ndarray) -> np.ndarray:
    """[3, 3] by Rodrigues' formula: rotation by 2 acos(w) around (x, y, z)."""
    w, v = quat[0], quat[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Real spherical harmonics at unit directions [*, 3], from their definition: [*, (degree + 1)²].

    Order l² + l + m; sine for m < 0, cosine for m > 0, each with the factor (-1)^m of Condon and Shortley.
    """
    x, y, z = np.moveaxis(np.asarray(directions, float), -1, 0)
    columns = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            order = abs(m)
            norm = (2 * band + 1) / (4 * np.pi) * math.factorial(band - order) / math.factorial(band + order)
            legendre = Legendre.basis(band).deriv(order)(z) if order else Legendre.basis(band)(z)
            around = (x + 1j * y) ** order  # sin(theta)^m exp(i m phi)
            angular = around.imag if m < 0 else around.real
            columns.append((-1) ** order * math.sqrt(norm * (2 if m else 1)) * legendre * angular)
    return np.stack(columns, axis=-1)
