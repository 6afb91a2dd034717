"""State that the calls share: scenes, renderer, queue, metrics, settings and the phase of the service."""

import logging
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from enum import Enum
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

import anyio
import anyio.to_thread
from fastapi import Depends, FastAPI, Request

from msdgs_serve.api.cameras import resolve_camera
from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.metrics import Metrics
from msdgs_serve.api.schemas import RenderRequest
from msdgs_serve.api.settings import Settings
from msdgs_serve.api.uploads import Uploads
from msdgs_serve.api.work import WorkQueue
from msdgs_serve.imaging import encode
from msdgs_serve.rasterizer.precompile import load_kernels
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import InvalidInput, MsdgsError, SceneFileInvalid
from msdgs_serve.store import SceneStore, ServedScene
from msdgs_serve.threads import lower_priority
from msdgs_serve.trial import try_scene

JOIN_SECONDS = 2.0
"""Time that shutdown waits for the thread that refreshes scenes: if it is killed, libraries print errors."""

READ_AT_ONCE = 2
"""Threads that read scene files for downloads: more would delay renders."""

logger = logging.getLogger("msdgs_serve")


class Phase(Enum):
    """Phases of a service."""

    STARTING = "starting"
    READY = "ready"
    DRAINING = "draining"
    FAILED = "failed"


class Service:
    """The state of an application."""

    def __init__(self, store: SceneStore, renderer: Renderer, settings: Settings) -> None:
        self.store = store
        self.renderer = renderer
        self.settings = settings
        self.queue = WorkQueue(
            settings.concurrent_renders,
            settings.queued_renders,
            settings.render_seconds,
            settings.unread_megabytes << 20,
        )
        self.uploads = Uploads(store.folder, settings)
        self.reading = anyio.CapacityLimiter(READ_AT_ONCE)
        self.metrics = Metrics(store, renderer, self.queue)
        self.phase = Phase.STARTING
        self.failure: MsdgsError | None = None
        self.start_seconds = 0.0
        self._stopped = threading.Event()
        self._phase_lock = threading.RLock()  # a signal may interrupt `drain` for another
        self._reported: dict[str, str] = {}

    @asynccontextmanager
    async def lifespan(self, _: FastAPI) -> AsyncIterator[None]:
        """Load scenes, warm up and refresh changed files in a thread, which is joined at the end."""
        thread = threading.Thread(target=self._load_and_refresh, name="scenes", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stopped.set()
            self.queue.shut_down()
            await anyio.to_thread.run_sync(thread.join, JOIN_SECONDS)

    def drain(self) -> None:
        """Finish admitted requests and reject new ones."""
        with self._phase_lock:
            self.phase = Phase.DRAINING
        self.queue.close()

    def scene(self, name: str | None) -> ServedScene:
        """Return the scene of a request; the name may be None if only one scene is served."""
        if name is None:
            names = self.store.names()
            if len(names) != 1:
                raise InvalidInput("scene", f"given, as {len(names)} scenes are served", "nothing")
            name = names[0]
        return self.store.get(name)

    def add_scene(self, name: str, incoming: Path, *, replace: bool) -> ServedScene:
        """Test an uploaded file in a subprocess and add it as the scene `name`.

        Raises `SceneFileInvalid` and the errors of `SceneStore.add`.
        """
        try_scene(incoming, self.settings.graph_limits, self.settings.trial_seconds)
        return self.store.add(name, incoming, replace=replace)

    def check_uploads(self) -> None:
        """Raise `RequestRejected` if clients may not add and delete scenes."""
        if not self.settings.uploads:
            raise RequestRejected(
                HTTPStatus.FORBIDDEN, "forbidden", "The service runs without --uploads: scenes can't be changed."
            )

    def log_rejected_upload(self, name: str, error: SceneFileInvalid) -> None:
        """Log why the file that a client uploaded as `name` is invalid, with details that the client isn't told."""
        details = f": {error.details}" if error.details else ""
        logger.info("upload of scene %r rejected: `%s` %s%s", name, error.field, error.problem, details)

    def _load_and_refresh(self) -> None:
        lower_priority()  # loading scenes must not delay requests
        started = time.perf_counter()
        try:
            self._warm_up()
        except MsdgsError as error:
            self.failure, self.phase = error, Phase.FAILED
            return
        except Exception:
            logger.exception("the service could not start")
            self.failure, self.phase = MsdgsError("could not start; see the log"), Phase.FAILED
            return
        self.start_seconds = time.perf_counter() - started
        with self._phase_lock:
            if self.phase is Phase.STARTING:
                self.phase = Phase.READY
        while not self._stopped.wait(self.settings.watch_seconds):
            self._refresh()

    def _warm_up(self) -> None:
        """Load the scenes given as files and meanwhile the kernels, and render a small frame of any scene."""
        files = [path.stem for path in self.settings.scenes if path.is_file()]
        kernels = threading.Thread(target=load_kernels, daemon=True)
        kernels.start()
        for name in files:
            self.store.get(name)
        kernels.join()
        for name in files or self.store.names():
            try:
                self._render_small(self.store.get(name))
            except MsdgsError as error:
                logger.error("no frame of scene %r: %s", name, error)
            else:
                return

    def _render_small(self, scene: ServedScene) -> None:
        camera = {"type": "orbit", "azimuth": 0, "elevation": 0}
        request = RenderRequest.model_validate({"camera": camera, "t": 0, "width": 32, "height": 32})
        t0, _ = scene.session.scene.metadata.time_range
        encode(self.renderer.render(scene.session, resolve_camera(request, scene), t0), "png")

    def _refresh(self) -> None:
        try:
            self.store.refresh()
            problems = {each.name: str(each.problem) for each in self.store.statuses() if each.problem}
            for name, problem in problems.items():
                if self._reported.get(name) != problem:
                    logger.error("%s", problem)
            self._reported = problems
            if self.settings.uploads:
                self.store.clear_incoming()
        except Exception:
            logger.exception("refreshing the scenes failed")


async def _service(request: Request) -> Service:
    """Return the service. A coroutine, as FastAPI runs plain functions in threads, for which health checks would
    wait."""
    return request.app.state.service


SharedService = Annotated[Service, Depends(_service)]
