"""Cache of posed Gaussians by scene and time; concurrent requests for the same pose compute it once."""

import threading
import weakref
from collections import OrderedDict
from concurrent.futures import Future
from dataclasses import dataclass

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.render_job import RenderCancelled, RenderJob
from msdgs_serve.scene import Gaussians, InvalidInput

PoseKey = tuple[weakref.ref[DeformationSession], float, float | None]

STAGE = "pose"


@dataclass(frozen=True)
class CacheUse:
    """Contents of the cache, and its hits and misses so far."""

    poses: int
    bytes: int
    hits: int
    misses: int


class PoseCache:
    """A least-recently-used cache of at most `capacity` bytes of posed Gaussians. Safe to use from several threads.

    Opacities and colors that don't depend on time are shared with the scene and don't count.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 0:
            raise InvalidInput("cache_bytes", "0 or more", capacity)
        self._capacity = capacity
        self._poses: OrderedDict[PoseKey, Future[Gaussians]] = OrderedDict()
        self._sizes: dict[PoseKey, int] = {}
        self._lock = threading.Lock()
        self._hits = self._misses = 0

    @property
    def use(self) -> CacheUse:
        """Current contents and counters."""
        with self._lock:
            return CacheUse(len(self._sizes), sum(self._sizes.values()), self._hits, self._misses)

    def get(self, session: DeformationSession, t: float, job: RenderJob, steps: float | None = None) -> Gaussians:
        """Return the scene's Gaussians at `t`, after `steps` layers or all; note `hit` or `miss` in the job.

        Those of a static scene are in memory already.
        """
        key = (weakref.ref(session), t, steps)  # a replaced scene is not kept alive
        with job.stage(STAGE):
            if not session.scene.moving_count:
                job.notes[STAGE] = "hit"
                return session.gaussians(t, steps)
            while True:
                future, mine = self._claim(key)
                job.notes[STAGE] = "miss" if mine else "hit"
                if mine:
                    self._compute(session, key, future)
                try:
                    return future.result()
                except RenderCancelled:
                    job.check()  # the job that computed it was cancelled, not this one: claim it again

    def _claim(self, key: PoseKey) -> tuple[Future[Gaussians], bool]:
        """Return the future of the pose, and whether the caller must compute it."""
        with self._lock:
            future = self._poses.get(key)
            mine = future is None
            if future is None:
                future = self._poses[key] = Future()
            self._poses.move_to_end(key)
            self._hits += not mine
            self._misses += mine
            return future, mine

    def _compute(self, session: DeformationSession, key: PoseKey, future: Future[Gaussians]) -> None:
        try:
            gaussians = session.gaussians(*key[1:])
        except BaseException as error:
            with self._lock:
                self._remove(key)
            future.set_exception(error)
            return
        with self._lock:
            self._sizes[key] = _own_bytes(gaussians, session)
            self._evict()
        future.set_result(gaussians)

    def _evict(self) -> None:
        for key in [key for key in self._sizes if key[0]() is None]:
            self._remove(key)
        total = sum(self._sizes.values())
        for key in [key for key in self._poses if key in self._sizes]:
            if total <= self._capacity:
                break
            total -= self._sizes[key]
            self._remove(key)

    def _remove(self, key: PoseKey) -> None:
        self._poses.pop(key, None)
        self._sizes.pop(key, None)


def _own_bytes(gaussians: Gaussians, session: DeformationSession) -> int:
    """Return the bytes of the arrays that are not shared with the scene."""
    scene = session.scene
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return sum(array.nbytes for array in arrays if array is not scene.opacities and array is not scene.sh)
