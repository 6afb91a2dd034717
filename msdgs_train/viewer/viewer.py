"""A page on which a model is looked at from all around and at any time, drawn by this project's rasterizer.

viser brings the page, its camera and its controls; images are put behind its own empty scene. One thread of this
process looks at what every browser wants to see and draws what it doesn't show yet: small images while something
moves, a large one when nothing does.
"""

import contextlib
import io
import math
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NamedTuple, Self, get_args

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput, MsdgsError, quaternion
from msdgs_train.engine.extras import ExtraMissing
from msdgs_train.gaussians.model_file import LoadedModel
from msdgs_train.viewer.snapshot import Channel, Snapshot, snapshot_of_file
from msdgs_train.viewer.stage import SceneView, view_of_file

LOOK_SECONDS = 1 / 30  # between looks at what browsers want
STILL_SECONDS = 0.2  # without a change: time for the large image
MOVING_PART = 0.5  # of the large image's sides, while something moves
JPEG_QUALITY = 90
LONGEST_SIDE = 640  # pixels, unless somebody moves the slider


class Wanted(NamedTuple):
    """What a browser is to show; where two are the same, so are the images of one model."""

    wxyz: tuple[float, ...]  # rotation, camera to world, OpenCV axes
    position: tuple[float, ...]  # world space
    fov_y: float  # radians
    canvas: tuple[int, int]  # width and height of the browser's image, pixels
    longest: int  # side of the image that is drawn, pixels, at most
    t: float
    layers: int
    channel: Channel

    def camera(self, part: float) -> Camera:
        """With sides that are this part of the large image's."""
        longest = part * min(self.longest, max(self.canvas))
        width, height = (max(1, round(longest * side / max(self.canvas))) for side in self.canvas)
        return camera_of_browser(np.array(self.wxyz), np.array(self.position), self.fov_y, width, height)


@dataclass
class _Browser:
    wanted: Wanted | None = None
    changed: float = 0.0  # when it began to want that
    drawn: tuple[Wanted, Snapshot, bool] | None = None  # and whether it was the large image


class Viewer:
    """The page. It is there from the beginning; it has controls from `open` on, and an image from `show` on."""

    def __init__(self, host: str, port: int) -> None:
        """Listens at once; where the port is taken, on one of the next.

        Raises `ExtraMissing` where viser isn't installed, `InvalidInput` where the port is none.
        """
        self.server = _serve(host, port)
        self.url = f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{self.server.get_port()}"
        self.share = 1.0
        """Of the time that drawing may take, in (0, 1]; the thread waits for the rest."""
        self._stage: SceneView | None = None
        self._snapshot: Snapshot | None = None
        self._browsers: dict[int, _Browser] = {}
        self._played: float | None = None  # when time was moved on
        self._closing = threading.Event()
        self._status = self.server.gui.add_markdown("")
        self._problem = self.server.gui.add_markdown("")
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self, stage: SceneView) -> None:
        """Add the controls, move all cameras to the first view, and begin to draw."""
        self._stage = stage
        gui, (first, last) = self.server.gui, stage.time_range
        moves = last > first
        step = (last - first) / 1000 if moves else 1.0
        middle = (first + last) / 2  # where training begins
        self._time = gui.add_slider("time", first, last if moves else first + 1, step, middle, visible=moves)
        self._playing = gui.add_checkbox("play", False, visible=moves)
        hint = "passes through all of the scene's time, a second"
        self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 0.25, visible=moves, hint=hint)
        layers, hint = stage.layers, "of the deformation; 0 shows the canonical Gaussians"
        self._layers = gui.add_slider("layers", 0, max(layers, 1), 1, layers, visible=layers > 0, hint=hint)
        self._channel = gui.add_dropdown("channel", get_args(Channel))
        hint = "longest side of the image in pixels; half of it while something moves"
        self._longest = gui.add_slider("resolution", 64, 2048, 32, LONGEST_SIDE, hint=hint)
        self.server.scene.set_up_direction(stage.up)
        early = [client.camera for client in self.server.get_clients().values()]
        for camera in (self.server.initial_camera, *early):
            camera.position, camera.look_at, camera.fov = stage.eye, stage.target, stage.fov_y
        for camera in early:
            camera.up_direction = stage.up
        self._thread.start()

    def show(self, snapshot: Snapshot) -> None:
        """From now on."""
        self._snapshot = snapshot

    @property
    def is_waiting(self) -> bool:
        """Whether a newer model would be drawn at once: somebody looks, and the last one has been drawn."""
        browsers = list(self._browsers.values())
        return any(browser.drawn is not None and browser.drawn[1] is self._snapshot for browser in browsers) or (
            self._snapshot is None and bool(self.server.get_clients())
        )

    def set_status(self, markdown: str) -> None:
        """Above the controls."""
        self._status.content = markdown

    def wait_for_interrupt(self) -> None:
        """Until Ctrl-C, which is raised."""
        self._closing.wait()

    def close(self) -> None:
        """The page is gone."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        with _silence():
            self.server.stop()

    def _run(self) -> None:
        while not self._closing.wait(LOOK_SECONDS):
            clients = self.server.get_clients()
            self._browsers = {name: self._browsers.get(name, _Browser()) for name in clients}
            snapshot = self._snapshot
            if snapshot is None or not clients:
                self._played = None
                continue
            self._move_time_on()
            started = time.perf_counter()
            drawn = [self._refresh(client, self._browsers[name], snapshot) for name, client in clients.items()]
            if any(drawn):
                self._closing.wait((time.perf_counter() - started) * (1 / self.share - 1))

    def _move_time_on(self) -> None:
        now, before = time.perf_counter(), self._played
        self._played = now if self._playing.value else None
        if self._stage is None or self._played is None or before is None:
            return
        first, last = self._stage.time_range
        passed = (self._time.value - first) / (last - first) + self._speed.value * (now - before)
        self._time.value = first + passed % 1 * (last - first)

    def _refresh(self, client: Any, browser: _Browser, snapshot: Snapshot) -> bool:
        """Draw what this browser wants and doesn't show; whether there was anything to draw."""
        wanted, now = self._wanted(client.camera), time.perf_counter()
        if wanted != browser.wanted:
            browser.wanted, browser.changed = wanted, now
        is_still = now - browser.changed >= STILL_SECONDS
        if browser.drawn == (wanted, snapshot, is_still):
            return False
        browser.drawn = wanted, snapshot, is_still
        try:
            camera = wanted.camera(1.0 if is_still else MOVING_PART)
            pixels = snapshot.draw(camera, wanted.t, wanted.layers, wanted.channel)
        except MsdgsError as error:
            self._problem.content = f"can't be drawn: {error}"
            return True
        if client.client_id in self.server.get_clients():  # it may have gone meanwhile
            client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=JPEG_QUALITY)
        if self._problem.content:
            self._problem.content = ""
        return True

    def _wanted(self, camera: Any) -> Wanted:
        return Wanted(
            tuple(camera.wxyz.tolist()),
            tuple(camera.position.tolist()),
            float(camera.fov),
            (max(1, camera.image_width), max(1, camera.image_height)),
            self._longest.value,
            self._time.value,
            self._layers.value,
            self._channel.value,
        )


def show_model(viewer: Viewer, loaded: LoadedModel, name: str) -> None:
    """What a file holds, and nothing else from then on."""
    viewer.set_status(f"**{name}**  \nstep {loaded.step:,}, {len(loaded.model.gaussians):,} Gaussians")
    viewer.open(view_of_file(loaded))
    viewer.show(snapshot_of_file(loaded))


def camera_of_browser(wxyz: np.ndarray, position: np.ndarray, fov_y: float, width: int, height: int) -> Camera:
    """What viser says of a browser's camera, as a pinhole.

    Args:
        wxyz: [4] quaternion, rotates OpenCV camera axes (x right, y down, z forward) into world axes.
        position: [3] world space.
        fov_y: vertical field of view in radians.
        width: of the image in pixels.
        height: of the image in pixels.
    """
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = quaternion.to_matrix(quaternion.normalize(wxyz))
    camera_to_world[:3, 3] = position
    return Camera.from_fov(camera_to_world, width, height, math.degrees(fov_y))


def _serve(host: str, port: int) -> Any:
    try:
        import viser  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError:
        raise ExtraMissing("the viewer", "viser", "viewer") from None
    if not 0 <= port <= 65535:
        raise InvalidInput("viewer_port", "in [0, 65535]", port)
    with _silence():
        server = viser.ViserServer(host=host, port=port, label="msdgs", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def _silence() -> contextlib.AbstractContextManager[Any]:
    """viser prints its address and its end whether it is asked to or not."""
    return contextlib.redirect_stdout(io.StringIO())
