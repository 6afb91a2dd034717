"""Default view of a scene, from its cameras or its bounds."""

import math
from dataclasses import dataclass, replace

import numpy as np

from msdgs_serve.scene.baked import SceneMetadata

DEFAULT_SIZE = 512
DEFAULT_FOV_Y = 50.0
MIN_CONVERGENCE = 0.02
"""Smallest mean squared sine of the angles between the viewing axes and their main direction at which their nearest
point is well defined; below it they are too parallel."""

NEAR_AXIS = 0.8
"""Cosine to a world axis from where the mean of cameras' up directions means this axis."""

LEVEL = 1e-9
"""Mean squared cosine between up and the sideways axes of cameras, below which all of them are level."""

ROUNDING = 1e-5
"""Rounding of the target, as a fraction of the bounds' diagonal: avoids long numbers in links."""


@dataclass(frozen=True)
class Framing:
    """Camera parameters for requests that leave them out."""

    target: np.ndarray  # [3] point that the cameras look at, or the center of the bounds
    distance: float  # of the camera from the target
    up: np.ndarray  # [3] unit
    fov_y: float  # degrees
    width: int
    height: int


def framing(metadata: SceneMetadata) -> Framing:
    """Return the default view in the user's world, from the scene's cameras, or from its bounds if it has none (then z
    is up)."""
    view, place = scene_framing(metadata), metadata.scene_to_world
    if place.is_identity:
        return view
    return replace(view, target=place.to_world(view.target), distance=place.scale * view.distance)


def scene_framing(metadata: SceneMetadata) -> Framing:
    """Return the default view in the frame of the scene's graph."""
    low, high = np.asarray(metadata.bounds, dtype=np.float64)
    target = (low + high) / 2
    if not metadata.cameras:
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
        distance = radius / math.sin(math.radians(DEFAULT_FOV_Y) / 2)
        return Framing(target, distance, np.array([0.0, 0.0, 1.0]), DEFAULT_FOV_Y, DEFAULT_SIZE, DEFAULT_SIZE)
    poses = np.array([each.camera.camera_to_world for each in metadata.cameras])
    target = _nearest_point(poses, low, high, target)
    distance = float(np.median(np.linalg.norm(poses[:, :3, 3] - target, axis=1)))
    first = metadata.cameras[0].camera
    fov_y = math.degrees(2 * math.atan(first.height / (2 * first.fy)))
    return Framing(target, max(distance, 1e-3), _up(poses), fov_y, first.width, first.height)


def _nearest_point(poses: np.ndarray, low: np.ndarray, high: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return the point nearest to all viewing axes of poses [N, 4, 4], if it is in the bounds and in front of most,
    else `otherwise`.

    Bounds include distant Gaussians, so that no camera may look at their center.
    """
    step = 10.0 ** np.floor(np.log10(ROUNDING * max(np.linalg.norm(high - low), 1e-3)))
    eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [N, 3, 3] projects onto the plane normal to an axis
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] < MIN_CONVERGENCE:
        return otherwise
    point = np.linalg.solve(system, (across @ eyes[:, :, None]).mean(axis=0)[:, 0])
    point = np.round(point / step) * step
    in_front = np.einsum("ni,ni->n", point - eyes, axes) > 0
    return point if in_front.mean() > 0.5 and np.all((low <= point) & (point <= high)) else otherwise


def _up(poses: np.ndarray) -> np.ndarray:
    """Return the up direction of poses [N, 4, 4]: exactly, if they are level and look around, otherwise their mean or
    the world axis that is close to it."""
    mean = -poses[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-3:
        return np.array([0.0, 0.0, 1.0])
    mean, close = mean / length, NEAR_AXIS
    sideways = poses[:, :3, 0]
    tilts, directions = np.linalg.eigh(sideways.T @ sideways / len(poses))  # of a level camera 0 along up
    if tilts[0] < LEVEL and tilts[1] > MIN_CONVERGENCE:
        mean, close = directions[:, 0] * np.sign(directions[:, 0] @ mean), 1 - LEVEL
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) > close:
        return np.sign(mean[axis]) * np.eye(3)[axis]
    return mean
