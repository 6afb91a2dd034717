"""A browser viewer of a model from any view at any time, drawn by this project's rasterizer.

viser provides the page, its camera and its controls; renderings are the background images of its empty scene. One
thread polls the state of every browser and draws changed views: small images during changes, then a large one.
"""

import contextlib
import io
import math
import threading
import time
from dataclasses import dataclass
from typing import Any, NamedTuple, Self, get_args

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput, MsdgsError, quaternion
from msdgs_train.engine.extras import ExtraMissing
from msdgs_train.gaussians.model_file import LoadedModel
from msdgs_train.viewer.scene_view import SceneView, view_of_file
from msdgs_train.viewer.snapshot import Channel, Snapshot

POLL_SECONDS = 1 / 30  # between polls of the browsers
IDLE_SECONDS = 0.2  # without a change before the large image is drawn
MOVING_PART = 0.5  # scale of the image during changes
JPEG_QUALITY = 90
LONGEST_SIDE = 640  # pixels; initial value of the slider


class Wanted(NamedTuple):
    """The view that a browser requests; equal requests give equal images of one model."""

    wxyz: tuple[float, ...]  # rotation, camera to world, OpenCV axes
    position: tuple[float, ...]  # world space
    fov_y: float  # radians
    canvas: tuple[int, int]  # width and height of the browser's image, pixels
    longest: int  # upper limit of the rendering's sides, pixels
    t: float
    layers: int
    channel: Channel

    def camera(self, scale: float) -> Camera:
        """Return the camera of the rendering, whose sides are `scale` times those of the large image."""
        longest = scale * min(self.longest, max(self.canvas))
        width, height = (max(1, round(longest * side / max(self.canvas))) for side in self.canvas)
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = quaternion.to_matrix(quaternion.normalize(np.array(self.wxyz)))
        camera_to_world[:3, 3] = self.position
        return Camera.from_fov(camera_to_world, width, height, math.degrees(self.fov_y))


@dataclass
class _Browser:
    wanted: Wanted | None = None
    changed: float = 0.0  # time of the last change of `wanted`
    drawn: tuple[Wanted, Snapshot, bool] | None = None  # the last drawn view; True for the large image


class Viewer:
    """The server of the page, which has controls after `open`, and an image after `show`."""

    def __init__(self, host: str, port: int) -> None:
        """Starts listening; on the next free port if the port is taken.

        Raises `ExtraMissing` if viser isn't installed, `InvalidInput` for an invalid port.
        """
        self.server = _serve(host, port)
        self.url = f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{self.server.get_port()}"
        self.time_fraction = 1.0
        """Maximum fraction of the time for drawing, in (0, 1]; the thread waits for the rest."""
        self._view: SceneView | None = None
        self._snapshot: Snapshot | None = None
        self._browsers: dict[int, _Browser] = {}
        self._played: float | None = None  # when the played time was last advanced
        self._closing = threading.Event()
        self._status = self.server.gui.add_markdown("")
        self._problem = self.server.gui.add_markdown("")
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def __enter__(self) -> Self:
        return self

    def open(self, view: SceneView) -> None:
        """Add the controls, move all cameras to the first view, and begin to draw."""
        self._view = view
        gui, (first, last) = self.server.gui, view.time_range
        moves = last > first
        step = (last - first) / 1000 if moves else 1.0
        middle = (first + last) / 2  # where the time window starts
        self._time = gui.add_slider("time", first, last if moves else first + 1, step, middle, visible=moves)
        self._playing = gui.add_checkbox("play", False, visible=moves)
        hint = "passes through the scene's time per second"
        self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 0.25, visible=moves, hint=hint)
        layers, hint = view.layers, "of the deformation; 0 shows the canonical Gaussians"
        self._layers = gui.add_slider("layers", 0, max(layers, 1), 1, layers, visible=layers > 0, hint=hint)
        self._channel = gui.add_dropdown("channel", get_args(Channel))
        hint = "longest side of the image in pixels; half of it during changes"
        self._longest = gui.add_slider("resolution", 64, 2048, 32, LONGEST_SIDE, hint=hint)
        self.server.scene.set_up_direction(view.up)
        early = [client.camera for client in self.server.get_clients().values()]
        for camera in (self.server.initial_camera, *early):
            camera.position, camera.look_at, camera.fov = view.eye, view.target, view.fov_y
        for camera in early:
            camera.up_direction = view.up
        self._thread.start()

    def show(self, snapshot: Snapshot) -> None:
        """Draw this snapshot from now on."""
        self._snapshot = snapshot

    @property
    def is_waiting(self) -> bool:
        """Whether a newer model would be drawn at once: a browser is connected, and shows the last one."""
        browsers = list(self._browsers.values())
        return any(browser.drawn is not None and browser.drawn[1] is self._snapshot for browser in browsers) or (
            self._snapshot is None and bool(self.server.get_clients())
        )

    def set_status(self, markdown: str) -> None:
        """Set the text above the controls."""
        self._status.content = markdown

    def wait_for_interrupt(self) -> None:
        """Block until Ctrl-C, which is raised."""
        self._closing.wait()

    def __exit__(self, *_: object) -> None:
        """Stop the server."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints its end
            self.server.stop()

    def _run(self) -> None:
        while not self._closing.wait(POLL_SECONDS):
            clients = self.server.get_clients()
            self._browsers = {name: self._browsers.get(name, _Browser()) for name in clients}
            snapshot = self._snapshot
            if snapshot is None or not clients:
                self._played = None
                continue
            self._advance_time()
            started = time.perf_counter()
            drawn = [self._refresh(client, self._browsers[name], snapshot) for name, client in clients.items()]
            if any(drawn):
                self._closing.wait((time.perf_counter() - started) * (1 / self.time_fraction - 1))

    def _advance_time(self) -> None:
        now, before = time.perf_counter(), self._played
        self._played = now if self._playing.value else None
        if self._view is None or self._played is None or before is None:
            return
        first, last = self._view.time_range
        passed = (self._time.value - first) / (last - first) + self._speed.value * (now - before)
        self._time.value = first + passed % 1 * (last - first)

    def _refresh(self, client: Any, browser: _Browser, snapshot: Snapshot) -> bool:
        """Draw the view of this browser if it has changed; returns whether it has."""
        wanted, now = self._wanted(client.camera), time.perf_counter()
        if wanted != browser.wanted:
            browser.wanted, browser.changed = wanted, now
        is_idle = now - browser.changed >= IDLE_SECONDS
        if browser.drawn == (wanted, snapshot, is_idle):
            return False
        browser.drawn = wanted, snapshot, is_idle
        try:
            camera = wanted.camera(1.0 if is_idle else MOVING_PART)
            pixels = snapshot.draw(camera, wanted.t, wanted.layers, wanted.channel)
        except MsdgsError as error:
            self._problem.content = f"can't be drawn: {error}"
            return True
        if client.client_id in self.server.get_clients():  # it may have disconnected meanwhile
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
    """Show the model of a file."""
    viewer.set_status(f"**{name}**  \nstep {loaded.step:,}, {len(loaded.model.gaussians):,} Gaussians")
    viewer.open(view_of_file(loaded))
    viewer.show(Snapshot(loaded.model, loaded.scene.background))


def _serve(host: str, port: int) -> Any:
    try:
        import viser  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError:
        raise ExtraMissing("the viewer", "viser", "viewer") from None
    if not 0 <= port <= 65535:
        raise InvalidInput("port", "in [0, 65535]", port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        server = viser.ViserServer(host=host, port=port, label="msdgs", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server
