"""Scene size for datasets that don't state it, from the sparse points or else from the cameras."""

import numpy as np

from msdgs_serve.scene import Camera

QUANTILE = 0.99
PARALLEL = 1e-3
"""Smallest eigenvalue, a mean squared sine, below which optical axes are treated as parallel: about 2°."""


def scene_half_size(points: np.ndarray | None, cameras: list[Camera]) -> float:
    """Return half the side of the cube around the origin with 99 % of the sparse `points`, [M, 3], in scene units.

    Without points, it holds a ball around the point nearest to all optical axes, whose radius is the median distance of
    the cameras; if the axes are parallel, a ball around the mean position that holds all cameras. `cameras` has one or
    more.
    """
    if points is not None and len(points):
        reach = float(np.quantile(np.abs(points).max(axis=1), QUANTILE))
    else:
        reach = _reach_of_cameras(cameras)
    return reach if reach > 0 else 1.0


def _reach_of_cameras(cameras: list[Camera]) -> float:
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.camera_to_world[:3, 2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [C, 3, 3], projects onto the plane normal to an axis
    mean = across.mean(axis=0)
    if np.linalg.eigvalsh(mean)[0] < PARALLEL:
        center = positions.mean(axis=0)
        radius = np.linalg.norm(positions - center, axis=1).max()
    else:
        center = np.linalg.solve(mean, np.einsum("cij,cj->i", across, positions) / len(cameras))
        radius = np.median(np.linalg.norm(positions - center, axis=1))
    return float(np.abs(center).max() + radius)
