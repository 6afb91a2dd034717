"""Bytes, opening, memory, posing and error of a scene file, from cameras that the export may not have used."""

import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.measuring import Times, machine, report_console, table
from msdgs_export.bake import bake
from msdgs_export.jobs.frame_memory import frame_memory
from msdgs_export.jobs.ruler import CAMERAS_PER_TIME, EVALUATION_TIMES
from msdgs_export.measure.frames import compare, render
from msdgs_export.measure.poses import in_float64
from msdgs_export.measure.rendered_error import by_time
from msdgs_export.measure.views import View, evaluation_views
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import build
from msdgs_export.progress import no_progress
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.scene.metadata import SceneCamera
from msdgs_train.datasets import load_scene
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.gaussians.model_file import load_model, save_model
from tests.support.models import SCENE, random_model

OPENINGS, POSES = 3, 30


def main(
    scene: Annotated[Path, tyro.conf.Positional] = Path("scene.onnx"),
    model: Path = Path("model.pt"),
    data: Path = Path("data/scene"),
    split: str = "val",
    size: int | None = None,
    check: bool = False,
) -> int:
    """Open a scene file, pose it, and compare 48 of its frames with those of its model in float64, drawn at other times
    than those of the images from cameras of one split of a dataset.

    python -m benchmarks.export.scene_file scene.onnx --model runs/scene/model.pt --data data/scene

    Memory is the peak of loading the file and drawing a frame, above that of the idle process.

    Args:
        scene: A file that `msdgs-export` made of the model.
        model: The `model.pt`.
        data: The folder of the dataset.
        split: Its split whose cameras are taken: val or test.
        size: Width of the frames in pixels; that of the images if not given.
        check: Test this benchmark on a small model.
    """
    if check:
        return self_test()
    try:
        report(scene, model, views_of(data, split, size, model), report_console())
    except MsdgsError as error:
        report_console().print(f"error: {error}", style="red", markup=False)
        return 1
    return 0


def views_of(data: Path, split: str, size: int | None, model: Path) -> list[View]:
    """Views from the cameras of a split, as an export has them from its own."""
    info = load_model(model).scene
    splits = load_scene(data, size).in_frame(info.placement).splits
    frames = splits.get(split, [])
    if not frames:
        raise InvalidInput("split", f"one with images: {', '.join(name for name in splits if splits[name])}", split)
    named = [(f"{split} {i}", frame.camera) for i, frame in enumerate(frames)]
    return evaluation_views(named, info.time_range, EVALUATION_TIMES, CAMERAS_PER_TIME)


def report(scene: Path, model: Path, views: list[View], console: Console) -> None:
    """Print one row of figures."""
    times = Times()
    for _ in range(OPENINGS):
        session = times.time("open", DeformationSession, scene)
    t0, t1 = session.scene.metadata.time_range
    for t in np.linspace(t0, t1, POSES):
        times.time("pose", session.gaussians, float(t))
    psnrs = errors(session, model, views)
    (memory,) = frame_memory([scene], SceneCamera("timed", views[0].t, views[0].camera), no_progress)
    poses = times.milliseconds()["pose"]
    made = table(f"{scene.name}, {len(psnrs)} frames", "MB", "opening, s", "memory, MB", "ms per pose: median", "least",
                 "worst frame, dB", "mean, dB")  # fmt: skip
    figures = [scene.stat().st_size / 1e6, times.minimum("open") / 1e3, (memory or 0) / 1e6]
    figures += [poses["median"], poses["min"], min(psnrs), float(np.mean(psnrs))]
    made.add_row(*(f"{figure:.2f}" for figure in figures))
    console.print(machine(), made)


def errors(session: DeformationSession, model: Path, views: list[View]) -> list[float]:
    """PSNR in dB of the frames at each of the views, against the model in float64."""
    loaded = load_model(model)
    pose, background, options = in_float64(loaded.model), loaded.scene.background, loaded.model.rasterizer
    found = []
    for t, views_then in track([*by_time(views)], "frames", console=Console(stderr=True)):
        exact, got = pose(t), session.gaussians(t)
        for view in views_then:
            target = render(exact, view.camera, background, options).astype(np.float32)
            found.append(compare(render(got, view.camera, background, options), target).psnr)
    return found


def self_test() -> int:
    """The exact network has no visible error, and a model with other parameters has one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        generate(folder / "data", size=32, train_frames=3, test_frames=2)
        for seed in (0, 1):
            model = random_model(200, seed, 0.05)
            save_model(folder / f"{seed}.pt", model, SCENE, 1)
        scene = folder / "scene.onnx"
        scene.write_bytes(build(BASELINE, bake(model, SCENE, "0" * 64)).SerializeToString())
        views, session = views_of(folder / "data", "test", None, folder / "1.pt"), DeformationSession(scene)
        assert min(errors(session, folder / "1.pt", views)) > 60
        assert min(errors(session, folder / "0.pt", views)) < 40
        return main(scene, folder / "1.pt", folder / "data", "test")


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
