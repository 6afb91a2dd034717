"""The live view: rendering, pausing, and no effect on training."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Camera, Gaussians, quaternion
from msdgs_serve.scene.camera import look_at
from msdgs_train.cli import main as cli
from msdgs_train.datasets import load_scene
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.engine.observer import Observer, Observers
from msdgs_train.engine.run import RunResult, fit
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.gaussians.model_file import LoadedModel, SceneInfo, save_model
from msdgs_train.viewer.scene_view import view_of_data, view_of_file
from msdgs_train.viewer.snapshot import Snapshot, snapshot_of_training
from msdgs_train.viewer.training_view import TrainingView
from msdgs_train.viewer.viewer import MOVING_PART, Viewer, Wanted, show_model
from tests.support.models import SCENE, random_model
from tests.support.processes import wait_for
from tests.support.tolerances import assert_close
from tests.support.training_scene import FEW, FOV, assert_same_bits, small_config, state_of
from tests.train.engine.viewer_page import PageClient, PageServer, page

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_curve")]

__all__ = ["page"]

WIDTH, HEIGHT = 60, 40
VIEW = Camera.from_look_at(np.array([2.0, -3.0, 1.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]), WIDTH, HEIGHT, 50.0)
CLOSER = Camera.from_look_at(np.array([1.0, -2.0, 1.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]), WIDTH, HEIGHT, 50.0)


@pytest.fixture
def loaded() -> LoadedModel:
    return LoadedModel(random_model(noise=0.2), SCENE, 7)


@contextlib.contextmanager
def viewed(page: PageServer, model: LoadedModel) -> Iterator[tuple[Viewer, PageClient]]:
    """A viewer of a model file with one browser."""
    with Viewer("127.0.0.1", 0) as viewer:
        show_model(viewer, model, "model.pt")
        page.clients[0] = client = PageClient(VIEW)
        yield viewer, client


def _expected(loaded: LoadedModel, camera: Camera, t: float, layers: int) -> np.ndarray:
    posed = loaded.model.pose(t, num_layers=layers)
    gaussians = Gaussians(*(tensor.detach().numpy() for tensor in posed))
    return to_bytes(rasterize(gaussians, camera, background=loaded.scene.background).rgb)


def _is_grey(drawn: np.ndarray) -> bool:
    return int(np.ptp(drawn, axis=2).max()) == 0


def test_a_browsers_camera_is_converted() -> None:
    """Axes are OpenCV's in both, viser's field of view is vertical and in radians."""
    pose = look_at(np.array([1.0, 2.0, 0.5]), np.array([-0.3, 0.1, 0.2]), np.array([0.0, 0.0, 1.0]))
    wxyz = quaternion.from_matrix(pose[:3, :3])
    wanted = Wanted(tuple(2 * wxyz), tuple(pose[:3, 3]), np.radians(50.0), (300, 200), 300, 0.0, 0, "rgb")
    camera = wanted.camera(1.0)
    assert_close(camera.camera_to_world, pose, "rotation")
    top = pose[:3, 3] + pose[:3, :3] @ [0.0, -np.tan(np.radians(25.0)), 1.0]
    right = pose[:3, 3] + pose[:3, :3] @ [1.5 * np.tan(np.radians(25.0)), 0.0, 1.0]
    pixels, depths = camera.project(np.stack([top, right]))
    assert_close(pixels, [[150, 0], [300, 100]], "pixel")
    assert_close(depths, np.ones(2), "rotation")


def test_images_are_small_while_it_moves_and_large_at_rest(page: PageServer, loaded: LoadedModel) -> None:
    with viewed(page, loaded) as (_, client):
        wait_for(lambda: len(client.images) == 2)
        small = VIEW.resized(round(MOVING_PART * WIDTH), round(MOVING_PART * HEIGHT))
        np.testing.assert_array_equal(client.images[0], _expected(loaded, small, 0.5, 2))
        np.testing.assert_array_equal(client.images[1], _expected(loaded, VIEW, 0.5, 2))
        time.sleep(0.3)
        assert len(client.images) == 2, "an unchanged view isn't drawn again"
        client.look_from(CLOSER)
        wait_for(lambda: len(client.images) == 4)
        np.testing.assert_array_equal(client.images[3], _expected(loaded, CLOSER, 0.5, 2))
    assert "step 7" in page.texts[0].content


def test_controls_change_what_is_drawn(page: PageServer, loaded: LoadedModel) -> None:
    with viewed(page, loaded) as (_, client):
        wait_for(lambda: len(client.images) == 2)
        assert page.controls["layers"].limits == (0, 2, 1)
        page.controls["time"].value, page.controls["layers"].value = 0.9, 1
        wait_for(lambda: np.array_equal(client.images[-1], _expected(loaded, VIEW, 0.9, 1)))
        page.controls["channel"].value = "alpha"
        wait_for(lambda: client.images[-1].shape == (HEIGHT, WIDTH, 3) and _is_grey(client.images[-1]))
        page.controls["resolution"].value = 30
        wait_for(lambda: client.images[-1].shape == (20, 30, 3))


def test_playing_goes_round(page: PageServer, loaded: LoadedModel) -> None:
    scene = SceneInfo(time_range=(0.2, 0.8), background=SCENE.background, cameras=SCENE.cameras)
    with viewed(page, loaded._replace(scene=scene)):
        page.controls["speed"].value, page.controls["play"].value = 2.0, True
        seen: list[float] = []

        def has_turned() -> bool:
            seen.append(page.controls["time"].value)
            return any(after < before for before, after in itertools.pairwise(seen))

        wait_for(has_turned)
        assert min(seen) >= 0.2
        assert max(seen) <= 0.8


def test_depth_is_white_where_it_is_nearest() -> None:
    model = random_model(2, noise=0.0)
    with torch.no_grad():
        model.gaussians.means.copy_(torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 2.0]]))
        model.gaussians.log_scales.fill_(-2.5)
        model.gaussians.raw_opacities.fill_(5.0)
    camera = Camera.from_fov(look_at(np.array([0.0, 0, -4]), np.zeros(3), np.array([0.0, -1, 0])), 80, 40, 40.0)
    drawn = Snapshot(model, (1.0, 1.0, 1.0)).draw(camera, 0.0, 0, "depth")
    (near, far), _ = camera.project(model.gaussians.means.detach().numpy())
    assert drawn[20, int(near[0]), 0] > 250
    assert drawn[20, int(far[0]), 0] < 5
    assert drawn[0, 0, 0] == 0


def test_a_model_without_motion_or_cameras_can_be_seen(page: PageServer) -> None:
    static = LoadedModel(random_model(layers=(), embedding_dim=0), SceneInfo(time_range=(1.0, 1.0)), 3)
    with viewed(page, static) as (_, client):
        wait_for(lambda: len(client.images) == 2)
        assert client.images[1].any()


def test_values_that_are_not_finite_are_reported_until_they_are(page: PageServer, loaded: LoadedModel) -> None:
    broken = random_model(noise=0.2)
    with torch.no_grad():
        broken.gaussians.means[5] = float("nan")
    with viewed(page, loaded._replace(model=broken)) as (viewer, client):
        wait_for(lambda: "can't be drawn" in page.texts[1].content)
        assert client.images == []
        viewer.show(Snapshot(loaded.model, loaded.scene.background))
        wait_for(lambda: client.images)
        wait_for(lambda: page.texts[1].content == "")


def test_the_first_view_is_that_of_an_image(data: Path) -> None:
    scene = load_scene(data)
    first, stage = scene.splits["train"][0].camera, view_of_data(scene, 2)
    pose = look_at(stage.eye, stage.target, stage.up)
    assert_close(pose, first.camera_to_world, "rotation")
    assert_close(np.degrees(stage.fov_y), FOV, "rotation")
    assert_close(stage.target, np.zeros(3), "rotation")
    assert view_of_file(LoadedModel(random_model(), SCENE, 7)).layers == 2


def test_a_snapshot_stays_as_it_was(data: Path) -> None:
    """Also in the static phase, in which nothing is deformed."""
    trainer = Trainer(small_config(), load_scene(data))
    camera = trainer.scene.splits["train"][0].camera
    for deforms in (False, True):
        assert trainer.schedule.deforms(trainer.step_count) is deforms
        snapshot = snapshot_of_training(trainer)
        before = snapshot.draw(camera, 0.3, 2)
        for _ in range(8):
            trainer.step()
        again = Snapshot(snapshot.model, snapshot.background, snapshot.deform, snapshot.sh_degree)  # poses again
        np.testing.assert_array_equal(before, again.draw(camera, 0.3, 2))
        assert not np.array_equal(before, snapshot_of_training(trainer).draw(camera, 0.3, 2))


class _LooksOn(Observer):
    """From the first step; after some steps it waits for another image."""

    def __init__(self, page: PageServer) -> None:
        self._page, self.client = page, PageClient(VIEW)

    def on_train_start(self, trainer: Trainer) -> None:
        self._page.clients[0] = self.client

    def step(self, result: StepResult, seconds: float) -> None:
        if result.step % 3 == 0:
            before = len(self.client.images)
            wait_for(lambda: len(self.client.images) > before)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_the_viewer_changes_no_bit_of_training(data: Path, tmp_path: Path, page: PageServer, batch_size: int) -> None:
    config = small_config(threads=2, batch_size=batch_size)
    fit(config, data, tmp_path / "alone")
    looks_on = _LooksOn(page)
    with Viewer("127.0.0.1", 0) as viewer:
        fit(config, data, tmp_path / "seen", observer=Observers(TrainingView(viewer, config.run.steps), looks_on))
    drawings = [drawn for drawn in looks_on.client.images if drawn.shape == (HEIGHT, WIDTH, 3)]
    assert len(drawings) >= 2
    assert not np.array_equal(drawings[0], drawings[-1]), "no image was drawn during training"
    assert_same_bits(state_of(tmp_path / "alone"), state_of(tmp_path / "seen"))
    assert "**step 24** of 24" in page.texts[0].content
    assert "PSNR" in page.texts[0].content


class _Stoppable(Observer):
    def __init__(self) -> None:
        self.last, self.stop, self.asked = 0, False, 0

    def step(self, result: StepResult, seconds: float) -> None:
        self.last, self.asked = result.step, 0

    def is_paused(self) -> bool:
        """Called repeatedly while another observer pauses the run."""
        self.asked += 1
        return False

    def should_stop(self) -> bool:
        return self.stop


def test_a_pause_holds_the_run_takes_no_time_and_can_be_stopped(data: Path, tmp_path: Path, page: PageServer) -> None:
    config, watched, outcomes = small_config(steps=100_000, eval_every=0), _Stoppable(), list[RunResult]()
    with Viewer("127.0.0.1", 0) as viewer:
        observers = Observers(watched, TrainingView(viewer, config.run.steps))
        thread = threading.Thread(
            target=lambda: outcomes.append(fit(config, data, tmp_path / "run", observer=observers))
        )
        started = time.perf_counter()
        thread.start()
        wait_for(lambda: watched.last >= 3)
        page.controls["pause"].value = True
        wait_for(lambda: watched.asked > 2)
        step, paused = watched.last, time.perf_counter()
        page.clients[0] = client = PageClient(VIEW)
        wait_for(lambda: len(client.images) >= 2)
        assert watched.last == step
        pause = time.perf_counter() - paused
        page.controls["pause"].value = False
        wait_for(lambda: watched.last > step)
        page.controls["pause"].value = True
        watched.stop = True
        thread.join(600)
    assert outcomes[0].status == "interrupted"
    assert outcomes[0].step == watched.last
    assert (tmp_path / "run" / "checkpoint.pt").exists()
    assert outcomes[0].seconds < time.perf_counter() - started - pause


def test_the_page_stays_after_the_run(
    data: Path, tmp_path: Path, page: PageServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page.clients[0] = client = PageClient(VIEW)

    def ctrl_c(viewer: Viewer) -> None:
        before = len(client.images)
        wait_for(lambda: len(client.images) > before)

    monkeypatch.setattr(Viewer, "wait_for_interrupt", ctrl_c)
    assert cli.main(["fit", str(data), str(tmp_path / "run"), "--steps=2", *FEW, "--viewer"]) == 0
    printed = capsys.readouterr().out
    assert "viewer: http://localhost:8080" in printed
    assert "Ctrl-C closes it" in printed


def test_a_model_file_is_viewed(
    tmp_path: Path, page: PageServer, loaded: LoadedModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_model(tmp_path / "model.pt", loaded.model, loaded.scene, 7)
    client = PageClient(VIEW)

    def ctrl_c(viewer: Viewer) -> None:
        page.clients[0] = client
        wait_for(lambda: len(client.images) == 2)

    monkeypatch.setattr(Viewer, "wait_for_interrupt", ctrl_c)
    assert cli.main(["view", str(tmp_path / "model.pt")]) == 0
    np.testing.assert_array_equal(client.images[1], _expected(loaded, VIEW, 0.5, 2))
