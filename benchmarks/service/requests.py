"""Requests for frames, and the same frames from the renderer without HTTP."""

import hashlib
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.imaging import FORMATS, ImageFormat, encode
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit

SIZES, TIMES = (200, 300, 400), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
MIXED_FORMATS: Sequence[ImageFormat] = ("jpeg", "jpeg", "jpeg", "png", "png", "webp", "exr", "npy")
ELEVATION = 20.0


class Wanted(NamedTuple):
    """A request for a frame, from a camera that orbits a scene whose time range is [0, 1]."""

    scene: str
    azimuth: float
    t: float
    size: int
    image_format: ImageFormat

    def body(self) -> dict[str, Any]:
        """The body of `POST /render`."""
        camera = {"type": "orbit", "azimuth": self.azimuth, "elevation": ELEVATION}
        size = {"width": self.size, "height": self.size}
        return {"scene": self.scene, "camera": camera, "t": self.t, "format": self.image_format, **size}


def mixed(count: int, scenes: Sequence[str]) -> list[Wanted]:
    """Seeded random requests for all scenes, times, sizes and formats."""
    chance = random.Random(0)
    return [
        Wanted(
            scenes[number % len(scenes)], float(chance.randrange(360)), chance.choice(TIMES), chance.choice(SIZES),
            chance.choice(MIXED_FORMATS),
        )
        for number in range(count)
    ]  # fmt: skip


def images(count: int, scene: str) -> list[Wanted]:
    """Requests for 400 × 400 JPEGs at one time, from many azimuths."""
    return [Wanted(scene, float(37 * number % 360), 0.5, 400, "jpeg") for number in range(count)]


class Offline:
    """The renderer without HTTP, for the scenes of a folder."""

    def __init__(self, folder: Path) -> None:
        self._renderer = Renderer()
        self._sessions = {path.stem: DeformationSession(path) for path in folder.glob("*.onnx")}

    def draw(self, wanted: Wanted) -> bytes:
        """The file that the service must answer with."""
        session = self._sessions[wanted.scene]
        view = framing(session.scene.metadata)
        pose = orbit(view.target, view.distance, wanted.azimuth, ELEVATION, view.up)
        camera = Camera.from_fov(pose, wanted.size, wanted.size, view.fov_y)
        holds_float = FORMATS[wanted.image_format].holds_float
        options = RenderOptions("transparent" if holds_float else "scene", depth=holds_float)
        image = self._renderer.render(session, camera, wanted.t, options)
        return encode(image, wanted.image_format)


def digest(body: bytes) -> str:
    """SHA-256 of a body."""
    return hashlib.sha256(body).hexdigest()
