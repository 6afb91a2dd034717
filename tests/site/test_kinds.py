"""Scenes of all kinds in a browser: they open, and look as the service draws them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from rich.console import Console

from msdgs_export.bake import bake
from msdgs_export.importers.runs.model import write_model
from msdgs_export.importers.scene import static_scene
from msdgs_export.importers.sequence import Frames, sequence_scene
from msdgs_export.importers.splats.base import Splats
from msdgs_export.plans.registry import build
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.scene.similarity import Similarity
from msdgs_train.gaussians.model_file import SceneInfo, load_model
from tests.support import foreign_runs as foreign
from tests.support.pages import watched_page
from tests.support.processes import wait_until_still
from tests.support.scene_files import write_scene
from tests.support.sites import drawn_by_the_service, needs_runtime, picture, psnr, write_site
from tests.support.splat_files import some_gaussians
from tests.support.tolerances import tolerance

pytestmark = [pytest.mark.slow, needs_runtime]


@pytest.fixture(autouse=True)
def _networks_are_read_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in a process of its own, which first loads torch."""
    monkeypatch.setattr("msdgs_export.importers.runs.state.read_guarded", lambda read, file: read(file))


def static(file: Path) -> None:
    file.write_bytes(static_scene(Splats(some_gaussians(500, 3)), "0" * 64).SerializeToString())


def large(file: Path) -> None:
    gaussians = some_gaussians(300_000)
    gaussians = replace(gaussians, scales=gaussians.scales / 8)
    file.write_bytes(static_scene(Splats(gaussians), "0" * 64).SerializeToString())


def sequence(seeds: tuple[int, ...], *, blended: bool = True) -> Callable[[Path], None]:
    def write(file: Path) -> None:
        frames = tuple(some_gaussians(500, 3, seed) for seed in seeds)
        file.write_bytes(sequence_scene(Frames(frames, 0, "mip", blended), "0" * 64).SerializeToString())

    return write


def fading(file: Path) -> None:
    write_scene(file, moving=3, changing=("opacities", "sh"))


def far_away(file: Path) -> None:
    write_scene(file, scene_to_world=Similarity(50.0, (4e5, 5e6, 100.0)), eps2d=0.1)


def run_of_4dgs(file: Path) -> None:
    state = foreign.fourdgs_state((1,))
    run = foreign.write_fourdgs(file.parent / "run", state, f"{foreign.SWITCHES}, no_do=False, no_dshs=False")
    write_model(run, "4dgs", file.parent / "model.pt", Console(quiet=True))
    model = load_model(file.parent / "model.pt").model
    file.write_bytes(build("network", bake(model, SceneInfo(), "0" * 64)).SerializeToString())


@pytest.mark.parametrize(
    "write",
    [static, large, sequence((0, 1, 2)), sequence((0, 1, 2), blended=False), fading, far_away, run_of_4dgs],
    ids=["static", "300,000", "sequence", "switched", "fading", "far away", "4dgs"],
)
def test_it_looks_as_the_service_draws_it(
    browser: Browser, folder: Path, server: str, tmp_path: Path, write: Callable[[Path], None]
):
    file = tmp_path / "scene.onnx"
    write(file)
    write_site(file, folder / tmp_path.name)
    scene = DeformationSession(file).scene
    view, (first, last) = framing(scene.metadata), scene.metadata.time_range
    t = round(first + 0.37 * (last - first), 3)
    at = ",".join(f"{number!r}" for number in (40.0, 10.0, view.distance, *view.target.tolist()))
    with watched_page(browser, reduced_motion="reduce") as page:
        page.goto(f"{server}/{tmp_path.name}/#t={t}&at={at}")
        wait_until_still(page)
        assert page.locator("#timeline").is_visible() == scene.changes
        assert not page.locator("#banner").is_visible()
        got = picture(page)
        page.keyboard.press("?")
        expect(page.locator("#help")).to_be_visible()
        assert page.get_by_text("play, pause").is_visible() == scene.changes
    wanted = drawn_by_the_service(file, t, 40.0, 10.0, (got.shape[1], got.shape[0]))
    assert wanted.std() > 0.01
    assert psnr(got, wanted) >= tolerance("drawn_here_db")
