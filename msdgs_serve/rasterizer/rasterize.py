"""Gaussians and a camera to an image."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT, RasterizerOptions
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians


class Rendering(NamedTuple):
    """One frame in the dtype of its Gaussians."""

    rgb: np.ndarray  # [H, W, 3] display-referred, the background included
    alpha: np.ndarray  # [H, W] 1 - transmittance
    depth: np.ndarray  # [H, W] expected distance along the camera axis, scene units, infinite where alpha is 0


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: npt.ArrayLike = (0.0, 0.0, 0.0),
    options: RasterizerOptions = GSPLAT,
) -> Rendering:
    """Draw the Gaussians (equations 1 and 2) over a background colour.

    Safe to call from several threads; the same input gives the same bytes, whatever the number of threads.

    Raises:
        InvalidInput: if an array of the Gaussians, the background or an option breaks its contract, by name.
    """
    gaussians.validate_shapes()
    background = np.asarray(background, dtype=gaussians.means.dtype)
    if background.shape != (3,) or not np.isfinite(background).all():
        raise InvalidInput("background", "3 finite numbers", background.tolist())
    splats = project(gaussians, camera, options)
    if not splats.sound:
        gaussians.validate()
    tiles = bin_into_tiles(splats, camera.width, camera.height)
    return Rendering(*composite(splats, tiles, camera.width, camera.height, background, options))
