"""Static models of single moments of a scene with several cameras, beside the dynamic model of all times."""

import csv
import io
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, NamedTuple

import numpy as np
import torch
import tyro
from rich.console import Console

from benchmarks.measuring import machine, report_console, table
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.writing import write_text
from msdgs_train.datasets import Frame, SceneData, load_scene
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.run import fit
from msdgs_train.engine.run_record import read_config, read_record
from msdgs_train.engine.trainer import Trainer
from msdgs_train.evaluation.evaluate import EvaluatedModel, evaluate_run
from msdgs_train.evaluation.metrics import masked_psnr, psnr
from msdgs_train.systems.registry import DEFAULT, preset

SPLITS = ("val", "test")
STEPS = 3000
MIN_CAMERAS = 3
"""Training images of a time that a static model can be made of."""
SAME_TIME = 1e-6


@dataclass(frozen=True)
class Options:
    """Train a static model on the images of one time, for several times, and compare it with a run's model of all times
    on held-out images of the same times. Where the static model is ahead, quality is lost to motion; where it is
    behind, other times add what its cameras don't see.

    python -m benchmarks.training.static_oracle runs/bench/msdgs-nodes/toybench_dome_200_0

    The static model is the default system without layers, trained for 3,000 steps at the size and seed of the run.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of finished runs, of `fit` or `compare`, on scenes with several cameras a time."""
    times: int = 10
    """Held-out times of each split, evenly spread."""
    steps: int = STEPS
    threads: int = 1
    csv: Path | None = None
    """The file that gets a row for each image; none if not given."""
    check: bool = False
    """Test this benchmark at a small size."""


class Scores(NamedTuple):
    """PSNR in dB: of the image, and of its moving region, if it has one."""

    psnr: float
    moving: float | None


@dataclass(frozen=True)
class Row:
    """A held-out image, drawn by both models."""

    scene: str
    split: str
    image: str
    t: float
    cameras: int  # training images of this time
    seed: int
    static: Scores
    dynamic: Scores


def main(options: Options) -> int:
    """Measure and print."""
    if options.check:
        return self_test(options)
    try:
        if not options.runs:
            raise InvalidInput("runs", "folders of finished runs", "none")
        if options.times < 1:
            raise InvalidInput("times", "1 or more", options.times)
        rows = [row for run in options.runs for row in rows_of_run(run, options)]
    except MsdgsError as error:
        report_console().print(f"error: {error}", style="red", markup=False)
        return 1
    show(rows)
    if options.csv:
        write(rows, options.csv)
    return 0


def rows_of_run(run: Path, options: Options) -> Iterator[Row]:
    """A row for each held-out image of the chosen times."""
    config, record = read_config(run), read_record(run)
    if record is None:
        raise InvalidInput("runs", "folders of finished runs", run)
    c = config.data
    static = oracle().updated(**asdict(c), steps=options.steps, threads=options.threads, seed=config.run.seed)
    scene = load_scene(record.data, c.size, c.llffhold, c.time_from, c.masks)
    for split in (split for split in SPLITS if scene.splits[split]):
        evaluation = evaluate_run(run, record.data, split, brief=True)
        dynamic = evaluation.models[0]
        scene = scene.in_frame(dynamic.loaded.scene.placement)
        times = spread_times(scene, evaluation.frames, options.times)
        if not times:
            raise InvalidInput("runs", f"of scenes with {MIN_CAMERAS} training images or more at held-out times", run)
        for t in times:
            moment = at_time(scene, t)
            Console(stderr=True).print(f"{record.data.name}, {split}: training at t = {t:.3f}", markup=False)
            trainer = trained(static, moment)
            for index, frame in enumerate(evaluation.frames):
                if is_at(frame, t):
                    drawn = draw(trainer, dynamic, frame, evaluation.masks[index])
                    found = dynamic.images[index]
                    yield Row(
                        scene=record.data.name,
                        split=split,
                        image=frame.name,
                        t=frame.t,
                        cameras=len(moment.splits["train"]),
                        seed=config.run.seed,
                        static=drawn,
                        dynamic=Scores(found.psnr, found.moving_psnr),
                    )


def oracle() -> TrainConfig:
    """The default system without motion. Its loss, start and density control matter with few views, for which the
    preset `static` isn't made."""
    return preset(DEFAULT).updated(support="gaussians", layers=(), static_fraction=0.0, window_full_fraction=0.0)


def spread_times(scene: SceneData, frames: Sequence[Frame], count: int) -> list[float]:
    """At most `count` of the frames' times at which there are enough training images, evenly spread."""
    every = sorted({frame.t for frame in frames})
    times = [t for t in every if len(at_time(scene, t).splits["train"]) >= MIN_CAMERAS]
    places = np.linspace(0, len(times) - 1, min(len(times), count)).round().astype(int)
    return [times[place] for place in places]


def at_time(scene: SceneData, t: float) -> SceneData:
    """The scene with the training images of one time, and none held out."""
    training = [frame for frame in scene.splits["train"] if is_at(frame, t)]
    return replace(scene, splits={split: [] for split in scene.splits} | {"train": training}, unsplit=None)


def is_at(frame: Frame, t: float) -> bool:
    return abs(frame.t - t) < SAME_TIME


def trained(config: TrainConfig, scene: SceneData) -> Trainer:
    """A trainer after all of its steps."""
    trainer = Trainer(config, scene)
    for _ in range(config.run.steps):
        trainer.step()
    return trainer


def draw(trainer: Trainer, dynamic: EvaluatedModel, frame: Frame, moving: np.ndarray) -> Scores:
    """Score the trainer's model on a held-out frame, against the image that the dynamic model is scored against."""
    background = torch.tensor(trainer.background)
    rgb = trainer.system.render(frame.camera, frame.t, background, trainer.step_count)
    target = dynamic.image(frame)
    return Scores(psnr(rgb, target), masked_psnr(rgb, target, moving))


def show(rows: Sequence[Row]) -> None:
    """Print a line for each scene, split and seed, and the mean over all images."""
    columns = ("images", "cameras", "static", "dynamic", "gain", "static, moving region", "dynamic", "gain")
    made = table("PSNR, dB, of a static model of one time and the model of all times", "scene", *columns)
    groups = {(row.scene, row.split, row.seed): None for row in rows}
    for scene, split, seed in groups:
        own = [row for row in rows if (row.scene, row.split, row.seed) == (scene, split, seed)]
        made.add_row(f"{scene}, {split}, seed {seed}", *cells(own))
    made.add_row("all", *cells(rows))
    report_console().print(machine(), made, sep="\n")


def cells(rows: Sequence[Row]) -> list[str]:
    """The numbers of a line."""
    cameras = sorted({row.cameras for row in rows})
    found = [str(len(rows)), "–".join(map(str, dict.fromkeys((cameras[0], cameras[-1]))))]
    found += compared([(row.static.psnr, row.dynamic.psnr) for row in rows])
    return found + compared([(row.static.moving, row.dynamic.moving) for row in rows])


def compared(pairs: Sequence[tuple[float | None, float | None]]) -> list[str]:
    """The means of both, and the gain of the second, over the pairs that are known."""
    known = [(static, dynamic) for static, dynamic in pairs if static is not None and dynamic is not None]
    if not known:
        return ["–"] * 3
    static, dynamic = (fmean(each) for each in zip(*known, strict=True))
    return [f"{static:.2f}", f"{dynamic:.2f}", f"{dynamic - static:+.2f}"]


def write(rows: Sequence[Row], file: Path) -> None:
    """Write the rows as CSV, atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", "split", "image", "t", "cameras", "seed", "static_psnr", "static_moving_psnr",
                     "dynamic_psnr", "dynamic_moving_psnr"])  # fmt: skip
    for row in rows:
        numbers = ["" if value is None else f"{value:.2f}" for value in (*row.static, *row.dynamic)]
        writer.writerow([row.scene, row.split, row.image, f"{row.t:.4f}", row.cameras, row.seed, *numbers])
    write_text(file, text.getvalue())


def self_test(options: Options) -> int:
    """A tiny scene of three cameras gives a row for each held-out image."""
    with tempfile.TemporaryDirectory() as folder:
        data, run, file = (Path(folder) / name for name in ("data", "run", "rows.csv"))
        generate(data, size=16, train_frames=3, test_frames=1, cameras=3)
        fit(preset("msdgs-small").updated(steps=4, init_num_pts=50, threads=1), data, run)
        ended = main(replace(options, check=False, runs=(run,), steps=3, csv=file))
        assert ended == 0
        assert len(file.read_text().splitlines()) > 1
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
