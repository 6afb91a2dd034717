"""The placement of a scene's own frame in the user's world: a scale and an offset, in float64."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput

MIN_SCALE, MAX_SCALE = 1e-9, 1e9


@dataclass(frozen=True)
class Similarity:
    """x_world = scale · x_scene + offset; both frames have the same axes.

    Training, the graph of a scene file and the rasterizer work in the scene's frame, near the origin and of a few
    units, so that float32 holds it; users see the world. Raises `InvalidInput` for a scale that isn't in [1e-9, 1e9].
    """

    scale: float = 1.0  # world units per scene unit
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the scene's origin, world units

    def __post_init__(self) -> None:
        if not MIN_SCALE <= self.scale <= MAX_SCALE:
            raise InvalidInput("scale", f"in [{MIN_SCALE:g}, {MAX_SCALE:g}]", self.scale)
        if len(self.offset) != 3 or not all(map(math.isfinite, self.offset)):
            raise InvalidInput("offset", "3 finite numbers", self.offset)

    @property
    def is_identity(self) -> bool:
        """Whether both frames are the same."""
        return self == IDENTITY

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """World points, float64, of scene points [..., 3]."""
        return self.scale * np.asarray(points, np.float64) + self.offset

    def to_scene(self, points: np.ndarray) -> np.ndarray:
        """Scene points, float64, of world points [..., 3]."""
        return (np.asarray(points, np.float64) - self.offset) / self.scale

    def camera_to_world(self, camera: Camera) -> Camera:
        """The camera in the world that has the same view as `camera` in the scene's frame."""
        return self._moved(camera, self.to_world(camera.position), 1 / self.scale)

    def camera_to_scene(self, camera: Camera) -> Camera:
        """The camera in the scene's frame that has the same view as `camera` in the world."""
        return self._moved(camera, self.to_scene(camera.position), self.scale)

    def _moved(self, camera: Camera, position: np.ndarray, units: float) -> Camera:
        """`units`: by how much a unit of the camera's frame is longer now."""
        if self.is_identity:
            return camera
        pose = camera.camera_to_world.copy()
        pose[:3, 3] = position
        zoom = units if camera.model == "orthographic" else 1.0  # whose focal lengths are in pixels per unit
        return replace(camera, camera_to_world=pose, fx=camera.fx * zoom, fy=camera.fy * zoom)

    def to_plain(self) -> dict[str, Any]:
        """JSON values."""
        return {"scale": self.scale, "offset": list(self.offset)}

    @classmethod
    def from_plain(cls, value: Mapping[str, Any]) -> "Similarity":
        """The inverse of `to_plain`. Raises `InvalidInput`, KeyError, TypeError or ValueError."""
        x, y, z = (float(each) for each in value["offset"])
        return cls(float(value["scale"]), (x, y, z))


IDENTITY = Similarity()
