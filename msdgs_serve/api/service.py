"""What the calls share: scenes, renderer, queue, metrics, settings, and what state the service is in."""

import logging
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from enum import Enum
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

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
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import InvalidInput, MsdgsError, SceneFileInvalid
from msdgs_serve.store import SceneStore, ServedScene
from msdgs_serve.threads import lower_priority
from msdgs_serve.trial import try_scene

JOIN_SECONDS = 2.0
"""That the end waits for the thread that looks after files: cut off amid a call, libraries complain on the terminal."""

logger = logging.getLogger("msdgs_serve")


class Phase(Enum):
    """Of a service's life."""

    STARTING = "starting"
    READY = "ready"
    DRAINING = "draining"
    FAILED = "failed"


class Service:
    """One for each application."""

    def __init__(self, store: SceneStore, renderer: Renderer, settings: Settings) -> None:
        self.store = store
        self.renderer = renderer
        self.settings = settings
        self.queue = WorkQueue(settings.concurrent_renders, settings.queued_renders, settings.render_seconds)
        self.uploads = Uploads(store.folder, settings)
        self.metrics = Metrics(store, renderer.cache, self.queue)
        self.phase = Phase.STARTING
        self.failure: MsdgsError | None = None
        self.start_seconds = 0.0
        self._stopped = threading.Event()
        self._reported: dict[str, str] = {}

    @asynccontextmanager
    async def lifespan(self, _: FastAPI) -> AsyncIterator[None]:
        """Load and warm up beside the event loop, look after changed files, let go of threads in the end."""
        thread = threading.Thread(target=self._load_and_refresh, name="scenes", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stopped.set()
            self.queue.shut_down()
            await anyio.to_thread.run_sync(thread.join, JOIN_SECONDS)

    def drain(self) -> None:
        """Finish what there is, refuse what comes."""
        self.phase = Phase.DRAINING
        self.queue.close()

    def scene(self, name: str | None) -> ServedScene:
        """The scene of a request, which may leave the name out where only one is served."""
        if name is None:
            names = self.store.names()
            if len(names) != 1:
                raise InvalidInput("scene", f"given, as {len(names)} scenes are served", "nothing")
            name = names[0]
        return self.store.get(name)

    def add_scene(self, name: str, incoming: Path, *, replace: bool) -> ServedScene:
        """A file that clients sent becomes a scene, once a process of its own could pose it.

        Raises `SceneFileInvalid`, and what `SceneStore.add` raises.
        """
        try_scene(incoming, self.settings.graph_limits, self.settings.trial_seconds)
        return self.store.add(name, incoming, replace=replace)

    def check_uploads(self) -> None:
        """Raises `RequestRejected` where clients may not add and delete scenes."""
        if not self.settings.uploads:
            raise RequestRejected(
                HTTPStatus.FORBIDDEN, "forbidden", "Scenes can't be added or deleted here: no --uploads."
            )

    def log_problem(self, error: SceneFileInvalid) -> None:
        """For the operator: what a client isn't told."""
        logger.error("%s", error)

    def _load_and_refresh(self) -> None:
        lower_priority()  # loading a scene disturbs nobody
        started = time.perf_counter()
        try:
            self._warm_up()
        except MsdgsError as error:
            self.failure, self.phase = error, Phase.FAILED
            return
        except Exception:
            logger.exception("the service could not start")
            self.failure, self.phase = MsdgsError("could not start; the log says why"), Phase.FAILED
            return
        self.start_seconds = time.perf_counter() - started
        if self.phase is Phase.STARTING:
            self.phase = Phase.READY
        while not self._stopped.wait(self.settings.watch_seconds):
            self._refresh()

    def _warm_up(self) -> None:
        """Load the scenes given as files, and draw one small frame so that the kernels are compiled."""
        if self.settings.uploads:
            self.store.clear_incoming()
        files = [path.stem for path in self.settings.scenes if path.is_file()]
        for name in files:
            self.store.get(name)
        for name in files or self.store.names():
            try:
                scene = self.store.get(name)
            except SceneFileInvalid as error:
                logger.error("%s", error)
                continue
            metadata = scene.session.scene.metadata
            camera = {"type": "orbit", "azimuth": 0, "elevation": 0}
            request = RenderRequest.model_validate({"camera": camera, "t": 0, "width": 32, "height": 32})
            encode(self.renderer.render(scene.session, resolve_camera(request, scene), metadata.time_range[0]), "png")
            return

    def _refresh(self) -> None:
        try:
            self.store.refresh()
            problems = {each.name: str(each.problem) for each in self.store.statuses() if each.problem}
            for name, problem in problems.items():
                if self._reported.get(name) != problem:
                    logger.error("%s", problem)
            self._reported = problems
        except Exception:
            logger.exception("looking at the scenes' files failed")


async def _service(request: Request) -> Service:
    """Not a plain function: those FastAPI calls on a thread, and a health check would wait for one."""
    return request.app.state.service


SharedService = Annotated[Service, Depends(_service)]
