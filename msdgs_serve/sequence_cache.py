"""Cache of frame sequences: cameras that have been asked for at several times keep what stands still drawn."""

import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import FrameSequence, RasterizerOptions, Rendering, TooManyPairs
from msdgs_serve.scene import Camera, Gaussians, InvalidInput, Region

MOST_MOVING = 0.6
"""Largest fraction of moving Gaussians. With 0.75, merging takes longer than a whole frame (1.06x)."""
REMEMBERED_CAMERAS = 1024
"""Cameras whose first frame is remembered; the second frame makes a sequence."""


@dataclass(frozen=True)
class SequenceUse:
    """Contents of the cache, and the frames that it has drawn or left to others so far."""

    sequences: int
    bytes: int
    drawn: int
    whole: int


@dataclass(frozen=True)
class FixedView:
    """What the frames of a sequence have in common."""

    camera: Camera
    background: tuple[float, float, float]
    depth: bool
    options: RasterizerOptions
    region: Region | None

    @property
    def key(self) -> tuple:
        """A hashable value that is equal for equal views."""
        camera = dict(vars(self.camera))
        pose: np.ndarray = camera.pop("camera_to_world")
        return (pose.tobytes(), *camera.values(), self.background, self.depth, self.options, self.region)


@dataclass
class _Entry:
    lock: threading.Lock = field(default_factory=threading.Lock)
    sequence: FrameSequence | None = None  # None: not made yet, or not kept
    is_too_large: bool = False  # for the memory of the cache


class SequenceCache:
    """A least-recently-used cache of at most `capacity` bytes of frame sequences. Safe to use from several threads.

    A sequence draws one frame at a time; others that are asked for meanwhile are left to the caller.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 0:
            raise InvalidInput("sequence_bytes", "0 or more", capacity)
        self._capacity = capacity
        self._entries: OrderedDict[tuple, _Entry] = OrderedDict()
        self._lock = threading.Lock()
        self._drawn = self._whole = 0

    @property
    def use(self) -> SequenceUse:
        """Current contents and counters."""
        with self._lock:
            kept = [entry.sequence.nbytes for entry in self._entries.values() if entry.sequence]
            return SequenceUse(len(kept), sum(kept), self._drawn, self._whole)

    def frame(self, session: DeformationSession, gaussians: Gaussians, view: FixedView) -> Rendering | None:
        """Return the frame of a scene's posed Gaussians, or None if it has to be drawn as a whole: the camera's first,
        while another thread draws a frame of this camera, or if much moves or memory is too small."""
        drawn = self._frame(session, gaussians, view)
        with self._lock:
            self._drawn += drawn is not None
            self._whole += drawn is None
        return drawn

    def _frame(self, session: DeformationSession, gaussians: Gaussians, view: FixedView) -> Rendering | None:
        moving, count = session.scene.moving_count, len(gaussians)
        if not 0 < moving <= MOST_MOVING * count or _least_bytes(gaussians, view) > self._capacity:
            return None
        key = (weakref.ref(session), view.key)  # a replaced scene is not kept alive
        entry = self._seen_before(key)
        if entry is None or not entry.lock.acquire(blocking=False):
            return None
        try:
            if entry.is_too_large:
                return None
            sequence = entry.sequence or _sequence(gaussians, moving, view)
            entry.is_too_large = sequence.nbytes > self._capacity
            if entry.sequence is None and not entry.is_too_large:
                entry.sequence = sequence
                self._evict()
            return sequence.frame(_rows(gaussians, slice(moving)))
        except TooManyPairs:
            entry.is_too_large = entry.sequence is None
            return None
        finally:
            entry.lock.release()

    def _seen_before(self, key: tuple) -> _Entry | None:
        """Return the entry of a camera; None the first time."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                self._entries[key] = _Entry()
            self._entries.move_to_end(key)
            once = [each for each, kept in self._entries.items() if kept.sequence is None]
            for each in once[: max(len(once) - REMEMBERED_CAMERAS, 0)]:
                del self._entries[each]
            return entry

    def _evict(self) -> None:
        with self._lock:
            for key in [key for key in self._entries if key[0]() is None]:
                del self._entries[key]
            sizes = {key: entry.sequence.nbytes for key, entry in self._entries.items() if entry.sequence}
            total = sum(sizes.values())
            for key, size in sizes.items():
                if total <= self._capacity:
                    break
                total -= size
                del self._entries[key]


def _sequence(gaussians: Gaussians, moving: int, view: FixedView) -> FrameSequence:
    return FrameSequence(
        _rows(gaussians, slice(moving, None)),
        moving,
        view.camera,
        background=view.background,
        depth=view.depth,
        options=view.options,
        region=view.region,
    )


def _rows(g: Gaussians, rows: slice) -> Gaussians:
    return Gaussians(g.means[rows], g.quats[rows], g.scales[rows], g.opacities[rows], g.sh[rows])


def _least_bytes(gaussians: Gaussians, view: FixedView) -> int:
    """Return a lower bound of the memory of a sequence."""
    size = view.region or view.camera
    return FrameSequence.least_bytes(len(gaussians), size.width * size.height, gaussians.means.dtype)
