"""The sparse model of a capture as arrays: poses, points and which image sees which point."""

from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from msdgs_serve.writing import replacing

GEOMETRY = "geometry.npz"
FORMAT = 3
"""Of that file; a step that made another one runs again."""
BUNDLE = 8
"""Observing cameras of a point among which its largest parallax is searched."""


@dataclass(frozen=True)
class Summary:
    """N registered images in the order of their names, P points; world units are the model's own."""

    names: np.ndarray  # [N] str
    camera_to_world: np.ndarray  # [N, 4, 4] float64, OpenCV axes
    intrinsics: np.ndarray  # [N, 4] focal length, principal point x and y in pixels, k1 of SIMPLE_RADIAL
    points: np.ndarray  # [P, 3] float64
    colors: np.ndarray  # [P, 3] uint8 sRGB
    observations: np.ndarray  # [M, 2] int64: image, point
    error: float  # mean reprojection error of the points in pixels
    method: str  # "incremental" or "global"
    others: tuple[int, ...]  # keyframes of the other models
    beyond_rotation: float  # pixels of the motion between keyframes that no rotation of the camera explains
    agreement: float  # observations of keyframes relative to their features that are found again in several ones

    def save(self, file: Path) -> None:
        """Write it as NPZ."""
        with replacing(file) as temporary:
            np.savez_compressed(temporary, **asdict(self))

    @staticmethod
    def load(file: Path) -> "Summary":
        """Read what `save` wrote."""
        with np.load(file) as stored:
            arrays = {field.name: stored[field.name] for field in fields(Summary)}
        numbers = {name: float(arrays[name]) for name in ("error", "beyond_rotation", "agreement")}
        others = tuple(int(size) for size in arrays["others"])
        return Summary(**{**arrays, **numbers, "method": str(arrays["method"]), "others": others})

    @property
    def centers(self) -> np.ndarray:
        """[N, 3] camera centers."""
        return self.camera_to_world[:, :3, 3]

    def depths(self) -> np.ndarray:
        """[M] depth of each observation, along the axis of its camera."""
        image, point = self.observations.T
        return np.einsum("mi,mi->m", self.points[point] - self.centers[image], self.camera_to_world[image, :3, 2])

    def parallax(self) -> np.ndarray:
        """[N] degrees: median over an image's points of the largest angle between its ray and those of other images.

        NaN for an image that observes no point.
        """
        image, point = self.observations.T
        rays = self.centers[image] - self.points[point]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        largest = np.zeros(len(rays))
        order = np.argsort(point, kind="stable")
        starts = np.flatnonzero(np.diff(point[order], prepend=-1))
        for rows in np.split(order, starts[1:]):
            chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), BUNDLE)).astype(int)]
            largest[rows] = np.degrees(np.arccos(np.clip(rays[rows] @ rays[chosen].T, -1, 1))).max(axis=1)
        return np.array(
            [np.median(largest[image == i]) if (image == i).any() else np.nan for i in range(len(self.names))]
        )
