"""A scene, a camera and a time → an image. No HTTP here."""

import threading
import weakref
from collections import OrderedDict
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Literal

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging import Image
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, rasterize
from msdgs_serve.scene import Camera, Gaussians, InvalidInput

Color = tuple[float, float, float]
Background = Color | Literal["scene", "transparent"]

DEFAULT_CACHED_POSES = 16

PoseKey = tuple[weakref.ref[DeformationSession], float]


@dataclass(frozen=True)
class RenderOptions:
    """How a frame is drawn."""

    background: Background = "scene"  # an sRGB-encoded colour, what the scene was trained on, or none
    rasterizer: RasterizerOptions = GSPLAT


DEFAULT_OPTIONS = RenderOptions()


class Renderer:
    """Draws scenes, and remembers the Gaussians posed last. Safe to use from several threads.

    Requests for the same scene and time that arrive together pose its Gaussians once.
    """

    def __init__(self, cached_poses: int = DEFAULT_CACHED_POSES) -> None:
        if cached_poses < 1:
            raise InvalidInput("cached_poses", "at least 1", cached_poses)
        self._capacity = cached_poses
        self._poses: OrderedDict[PoseKey, Future[Gaussians]] = OrderedDict()
        self._lock = threading.Lock()

    def render(
        self, session: DeformationSession, camera: Camera, t: float, options: RenderOptions = DEFAULT_OPTIONS
    ) -> Image:
        """The frame that `camera` sees at `t`. The same arguments give the same pixels, whatever else runs.

        Raises:
            InvalidInput: if `t` is outside of the scene's time range.
        """
        transparent = options.background == "transparent"
        background = resolve_background(session, options.background)
        gaussians = self.posed(session, t)
        rendering = rasterize(gaussians, camera, background=background, options=options.rasterizer)
        return Image(rendering.rgb, rendering.alpha, rendering.depth, transparent)

    def posed(self, session: DeformationSession, t: float) -> Gaussians:
        """The scene's Gaussians at `t`, from the cache where it has them."""
        key = (weakref.ref(session), t)  # a scene that was replaced is not kept alive
        with self._lock:
            future = self._poses.get(key)
            waiting = future is not None
            if future is None:
                future = self._poses[key] = Future()
                if len(self._poses) > self._capacity:
                    self._poses.popitem(last=False)
            self._poses.move_to_end(key)
        if not waiting:
            self._compute(session, t, key, future)
        return future.result()

    def _compute(self, session: DeformationSession, t: float, key: PoseKey, future: Future[Gaussians]) -> None:
        try:
            future.set_result(session.gaussians(t))
        except BaseException as error:
            with self._lock:
                if self._poses.get(key) is future:
                    del self._poses[key]
            future.set_exception(error)


def resolve_background(session: DeformationSession, background: Background) -> Color:
    """The colour to draw over; black where transparent, which makes the colours premultiplied."""
    if background == "transparent":
        return (0.0, 0.0, 0.0)
    if background == "scene":
        red, green, blue = session.scene.metadata.background
        return (red, green, blue)
    return background
