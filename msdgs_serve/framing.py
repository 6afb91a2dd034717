"""How a scene is seen where nothing is said of it: from its cameras, or its bounds."""

import math
from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene.baked import SceneMetadata

DEFAULT_SIZE = 512
DEFAULT_FOV_Y = 50.0
MIN_CONVERGENCE = 0.02
"""Of the viewing axes, the mean square sine of their angles to the direction that they have most in common; below it
they are so nearly parallel that where they meet says little."""

ROUNDING = 1e-5
"""Of the bounds' diagonal: what is finer is rounding of poses, and would fill links with digits."""


@dataclass(frozen=True)
class Framing:
    """What a camera needs and a request may leave out."""

    target: np.ndarray  # [3] what the cameras look at, or the middle of the bounds
    distance: float  # from there, to see all
    up: np.ndarray  # [3] unit
    fov_y: float  # degrees
    width: int
    height: int


def framing(metadata: SceneMetadata) -> Framing:
    """From the scene's cameras, or its bounds where it has none (then z is up)."""
    low, high = np.asarray(metadata.bounds, dtype=np.float64)
    target = (low + high) / 2
    if not metadata.cameras:
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
        distance = radius / math.sin(math.radians(DEFAULT_FOV_Y) / 2)
        return Framing(target, distance, np.array([0.0, 0.0, 1.0]), DEFAULT_FOV_Y, DEFAULT_SIZE, DEFAULT_SIZE)
    poses = np.array([each.camera.camera_to_world for each in metadata.cameras])
    target = _meeting_point(poses, low, high, target)
    distance = float(np.median(np.linalg.norm(poses[:, :3, 3] - target, axis=1)))
    first = metadata.cameras[0].camera
    fov_y = math.degrees(2 * math.atan(first.height / (2 * first.fy)))
    return Framing(target, max(distance, 1e-3), _up(poses), fov_y, first.width, first.height)


def _meeting_point(poses: np.ndarray, low: np.ndarray, high: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """The point nearest to all viewing axes of cameras, [N, 4, 4], where it lies in the bounds and ahead of most.

    Bounds hold Gaussians far out as well, so that their middle may be beside all that cameras look at.
    """
    grain = 10.0 ** np.floor(np.log10(ROUNDING * max(np.linalg.norm(high - low), 1e-3)))
    eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [N, 3, 3] takes the part along an axis away
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] < MIN_CONVERGENCE:
        return otherwise
    point = np.linalg.solve(system, (across @ eyes[:, :, None]).mean(axis=0)[:, 0])
    point = np.round(point / grain) * grain
    is_ahead = np.einsum("ni,ni->n", point - eyes, axes) > 0
    return point if is_ahead.mean() > 0.5 and np.all((low <= point) & (point <= high)) else otherwise


def _up(poses: np.ndarray) -> np.ndarray:
    """The mean of the up directions of cameras, [N, 4, 4]; the world axis that is near it, where one is."""
    mean = -poses[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-3:
        return np.array([0.0, 0.0, 1.0])
    mean = mean / length
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) > 0.8:
        return np.sign(mean[axis]) * np.eye(3)[axis]
    return mean
