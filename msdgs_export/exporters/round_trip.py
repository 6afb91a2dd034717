"""Round-trip check: a written file is read back, rendered, and compared with the scene."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime as ort

from msdgs_export.exporters.visionary import COLORS, COUNT, GAUSSIANS, unpacked
from msdgs_export.measure.frames import compare, render
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import scene_framing
from msdgs_serve.rasterizer import as_trained
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.gaussians import Gaussians

VIEWS, SIZE, ELEVATION = 3, 256, 20.0
"""Number of cameras around the scene, pixels of their shorter side, and elevation in degrees."""


class ConversionFailed(MsdgsError):
    """A written file differs visibly from the scene."""


class RoundTrip:
    """Frames of a scene, with which those of a converted one are compared."""

    def __init__(self, session: DeformationSession, *, mip: bool = True) -> None:
        """`mip`: whether the other format has the anti-aliasing of Mip-Splatting."""
        self._session, metadata = session, session.scene.metadata
        options = as_trained(metadata)
        self._options = options._replace(mip=options.mip and mip)
        view = scene_framing(metadata)
        shown = SIZE / min(view.width, view.height)
        size = max(1, round(view.width * shown)), max(1, round(view.height * shown))
        poses = [orbit(view.target, view.distance, 360 * i / VIEWS, ELEVATION, view.up) for i in range(VIEWS)]
        self._cameras = [Camera.from_fov(pose, *size, view.fov_y) for pose in poses]
        self._background = metadata.background

    def psnr(self, got: Gaussians, t: float) -> float:
        """PSNR of the worst view, dB, of Gaussians in the scene's frame; frames are clamped to [0, 1]."""
        both = (got, self._session.gaussians(t))

        def frames(camera: Camera) -> list[np.ndarray]:
            return [render(each, camera, self._background, self._options).astype(np.float64) for each in both]

        return min(compare(*frames(camera)).psnr for camera in self._cameras)


def visionary_of(file: Path) -> Callable[[float], Gaussians]:
    """The Gaussians of a Visionary model as a function of time."""
    session = ort.InferenceSession(str(file), providers=["CPUExecutionProvider"])

    def shown(t: float) -> Gaussians:
        names = [GAUSSIANS, COLORS, COUNT]
        gaussians, colors, count = (np.asarray(a) for a in session.run(names, {"time": np.array([t], np.float32)}))
        return unpacked(gaussians, colors.astype(np.float32), int(count[0]))

    return shown


def require(psnr: float, asked_for: float | None, default: float, name: str) -> None:
    """Raise `ConversionFailed` if `psnr` is below the requested minimum, by default that of the format."""
    minimum = default if asked_for is None else asked_for
    if not psnr >= minimum:
        raise ConversionFailed(f"{name} has {psnr:.1f} dB against the scene, and {minimum:g} dB were asked for")
