"""The kernels' form of a camera, and the options of the rasterizer."""

import math
from typing import NamedTuple, get_args

from msdgs_serve.scene.camera import Camera, CameraModel
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.metadata import SceneMetadata
from msdgs_serve.scene.region import Region

TILE = 16
"""Pixels along a tile's side."""


class RasterizerOptions(NamedTuple):
    """Constants in which published rasterizers differ."""

    near_plane: float  # scene units; Gaussians at this depth or nearer are not drawn
    eps2d: float  # px², added to the diagonal of the projected covariance
    alpha_min: float  # a Gaussian is skipped in pixels where its alpha is smaller
    alpha_max: float  # alpha is clamped to this
    transmittance_min: float  # a pixel stops before the Gaussian that would take it to this or less
    mip: bool = False  # scale opacity by √(det before eps2d / det after), as Mip-Splatting does


GSPLAT = RasterizerOptions(near_plane=0.01, eps2d=0.3, alpha_min=1 / 255, alpha_max=0.999, transmittance_min=1e-4)
INRIA = RasterizerOptions(near_plane=0.2, eps2d=0.3, alpha_min=1 / 255, alpha_max=0.99, transmittance_min=1e-4)


def as_trained(metadata: SceneMetadata, options: RasterizerOptions = GSPLAT) -> RasterizerOptions:
    """Return `options` with the anti-aliasing that a scene was trained with."""
    return options._replace(eps2d=metadata.eps2d, mip=metadata.antialiasing == "mip")


def in_tiles(region: Region, camera: Camera) -> Region:
    """Return the tiles that a part of a camera's image touches, as far as they are in the image."""
    x, y = region.x // TILE * TILE, region.y // TILE * TILE
    right, bottom = -(-region.right // TILE) * TILE, -(-region.bottom // TILE) * TILE
    return Region(x, y, min(right, camera.width) - x, min(bottom, camera.height) - y)


PINHOLE, ORTHOGRAPHIC, FISHEYE = range(len(get_args(CameraModel)))


class View(NamedTuple):
    """A camera as float64 numbers for the projection kernels.

    Tuples, not arrays, whose references kernels would count for every call that takes a view, in all threads.
    """

    rotation: tuple[tuple[float, float, float], ...]  # [3][3] world to camera
    translation: tuple[float, float, float]  # world to camera
    position: tuple[float, float, float]  # in world space
    fx: float
    fy: float
    cx: float
    cy: float
    # the part of the image that is drawn, in pixels; its left and upper sides are those of tiles
    left: int
    right: int
    top: int
    bottom: int
    # where x/z and y/z are clamped in the Jacobian, so that splats far off axis stay finite (gsplat's limits)
    min_x: float
    max_x: float
    min_y: float
    max_y: float
    model: int  # `PINHOLE`, `ORTHOGRAPHIC` or `FISHEYE`
    distortion: tuple[float, float, float, float]  # k1 to k4 of a fisheye camera
    near_plane: float
    eps2d: float
    mip: bool
    alpha_min: float
    log2_alpha_min: float


def view_of(camera: Camera, options: RasterizerOptions, tiles: Region | None = None) -> View:
    """Return the kernels' form of a camera of whose image whole `tiles` are drawn, or all. Raises `InvalidInput` for
    options out of range."""
    tiles = tiles or Region.whole(camera)
    _check(options)
    rotation, position = camera.camera_to_world[:3, :3].T, camera.position
    k1, k2, k3, k4 = map(float, camera.distortion)
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    return View(
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple((-(rotation @ position)).tolist()),
        position=tuple(position.tolist()),
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        left=tiles.x,
        right=tiles.right,
        top=tiles.y,
        bottom=tiles.bottom,
        min_x=-camera.cx / camera.fx - margin_x,
        max_x=(camera.width - camera.cx) / camera.fx + margin_x,
        min_y=-camera.cy / camera.fy - margin_y,
        max_y=(camera.height - camera.cy) / camera.fy + margin_y,
        model=get_args(CameraModel).index(camera.model),
        distortion=(k1, k2, k3, k4),
        near_plane=float(options.near_plane),
        eps2d=float(options.eps2d),
        mip=bool(options.mip),
        alpha_min=float(options.alpha_min),
        log2_alpha_min=math.log2(options.alpha_min),
    )


def _check(options: RasterizerOptions) -> None:
    bounds = {
        "near_plane": (options.near_plane > 0, "above 0"),
        "eps2d": (options.eps2d >= 0, "0 or more"),
        "alpha_min": (0 < options.alpha_min < 1, "in (0, 1)"),
        "alpha_max": (options.alpha_min < options.alpha_max < 1, "in (alpha_min, 1)"),
        "transmittance_min": (0 <= options.transmittance_min < 1, "in [0, 1)"),
    }
    for name, (holds, expected) in bounds.items():
        if not holds or not math.isfinite(getattr(options, name)):
            raise InvalidInput(f"options.{name}", expected, getattr(options, name))
