"""Videos for the tests: camera paths, `msdgs-render` and the frames of files."""

import io
from typing import Any

import av
import numpy as np
import PIL.Image
import PIL.ImageSequence

from msdgs_serve.render_cli import main
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV
from tests.support.scene_files import level_camera

SIZE = 64
POSE = level_camera().camera_to_world
ORBIT = {"type": "orbit", "azimuth": 0, "elevation": 0, "distance": 5, "fov_y": 40}


def nerfstudio(count: int = 3, **changes: Any) -> dict[str, Any]:
    """Return a camera path in nerfstudio's format: one pose, OpenGL axes, row by row."""
    camera = {"camera_to_world": (POSE @ OPENGL_TO_OPENCV).ravel().tolist(), "fov": 40.0, "aspect": 1.0}
    path = {"camera_path": [dict(camera) for _ in range(count)], "fps": 12, "seconds": 1}
    return {**path, "render_width": SIZE, "render_height": SIZE, **changes}


def frames_of(video: bytes) -> tuple[list[np.ndarray], float]:
    with av.open(io.BytesIO(video), "r") as container:
        rate = container.streams.video[0].average_rate
        assert rate is not None
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], float(rate)


def stills_of(webp: bytes) -> list[np.ndarray]:
    with PIL.Image.open(io.BytesIO(webp)) as image:
        return [np.asarray(frame.convert("RGB")) for frame in PIL.ImageSequence.Iterator(image)]


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])
