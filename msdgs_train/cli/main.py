"""`msdgs-train`: fit a moving scene to images, judge and look at what came out, or make a scene to try it on."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_train.engine.config import TrainConfig
from msdgs_train.systems.presets import DEFAULT, preset

if TYPE_CHECKING:
    from rich.table import Table

    from msdgs_train.evaluation.evaluate import Evaluation
    from msdgs_train.viewer.training_view import TrainingView
    from msdgs_train.viewer.viewer import Viewer

PresetName = Literal["msdgs-small", "msdgs-mlp", "msdgs-plane", "deformgs", "4dgs", "motion-bases", "static"]
"""Written out, so that `--help` and shells know them."""

EXIT_INVALID = 2
EXIT_INTERRUPTED = 130  # as a shell reports a program that Ctrl-C has stopped

console = Console()


@dataclass(frozen=True)
class Fit:
    """Train on a folder of images; RUN gets config.json, run.json, metrics.jsonl, curve.png, renders/,
    checkpoint.pt, model.pt (the last) and best.pt (of the highest PSNR on held-out images).

    Ctrl-C finishes the step, saves a checkpoint and stops. The same command with --resume goes on from there, with
    the same bits as if it had never stopped; more --steps, another --max-minutes and the like may be given then.

    A first look, in a few minutes:  msdgs-train fit data/scene runs/first --size 200 --steps 3000

    The paper's system with two layers:  msdgs-train fit data/scene runs/paper --preset msdgs-mlp --model.layers mlp mlp

    What a preset holds:  msdgs-train fit --preset deformgs --help
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """A dataset folder in the layout of D-NeRF, nerfstudio, COLMAP, Neu3D or HyperNeRF, seen from the files in it."""
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of this run; new, or one to --resume."""
    preset: PresetName = DEFAULT
    """Settings to begin with; options given beside it change them. msdgs-small is for two cores; msdgs-mlp and
    msdgs-plane are the paper's, deformgs and 4dgs what it compares with; static has no motion. docs/training.md"""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the run in RUN, with the settings it was begun with."""
    tensorboard: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also write what metrics.jsonl gets, and held-out renderings, to RUN/tensorboard; look at many runs with
    `tensorboard --logdir runs`. Needs: pip install 'msdgs[tensorboard]'"""
    viewer: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Open a page on which the model is seen while it is trained, from all around, at any time, after each layer; it
    stays when the run is over, until Ctrl-C. Needs: pip install 'msdgs[viewer]'"""
    viewer_port: int = 8080
    """Port of that page; where it is taken, one of the next. 0 takes a free one."""
    viewer_host: str = "127.0.0.1"
    """Address that it listens on; 0.0.0.0 for all networks, where anybody may then pause the run."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)


@dataclass(frozen=True)
class Synthetic:
    """Make a small moving scene with known motion, ray-marched into D-NeRF layout. No downloads, a few seconds.

    Example:  msdgs-train synthetic data/toy && msdgs-train fit data/toy runs/toy --steps 2000
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder to make."""
    size: int = 128
    """Width and height of the images in pixels."""
    train_frames: int = 64
    """At evenly spaced times, from all around."""
    test_frames: int = 12
    """Held out: at times between, from one smooth turn around the scene."""
    seed: int = 0
    """Of the cameras and times."""


@dataclass(frozen=True)
class Evaluate:
    """Judge the last and the best model of a run on held-out images: PSNR, SSIM, LPIPS, ꟻLIP, and PSNR where
    something moves, since a static background hides what is wrong with the motion.

    RUN/eval gets numbers for every image (<split>.json), a table (<split>.md) and a contact sheet of images,
    renderings and errors (<split>.png). LPIPS and ꟻLIP are left out where their packages or weights are not on this
    machine; nothing is downloaded.

    Example:  msdgs-train eval runs/first
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of a run that `msdgs-train fit` has filled."""
    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")] = None
    """The dataset, where it is not any more where the run found it."""
    split: Literal["test", "val", "train"] = "test"
    """Which images."""


@dataclass(frozen=True)
class Steps:
    """Draw the Gaussians after k = 0, 1, …, K layers of the deformation side by side: what each layer adds.

    Example:  msdgs-train steps runs/first/model.pt --t 0.9
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The model.pt or best.pt of a run."""
    t: float | None = None
    """Time, in the scene's range; left out: 0.3 of the way through it."""
    out: Path = Path("steps.png")
    """The PNG to write."""
    size: int = 400
    """Width of each image in pixels, the height in proportion."""
    camera: str | None = None
    """Name of a camera that the model holds; left out: the one whose image is nearest in time."""


@dataclass(frozen=True)
class View:
    """Open a page on which a trained model is seen from all around, at any time, after each layer of the deformation.
    It stays until Ctrl-C. Needs: pip install 'msdgs[viewer]'

    Example:  msdgs-train view runs/first/model.pt
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The model.pt or best.pt of a run."""
    port: int = 8080
    """Where it is taken, one of the next. 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all networks."""


@dataclass(frozen=True)
class Compare:
    """Train every system on every scene with every seed under one budget, and put them side by side: a table
    (comparison.md), all numbers (comparison.json), error against training time (time.png) and against the number of
    layers (layers.png).

    A system is a preset, or a table of a TOML file: the settings of `fit`, changed from a `preset`. What Ctrl-C has
    stopped goes on with the same command; finished runs aren't trained again.

    Example:  msdgs-train compare deformgs 4dgs mine.toml --data data/a data/b --out runs/all --steps 3000 --size 200
    --init-num-pts 5000 --max-gaussians 10000

    where mine.toml holds:  [k2]  preset = "msdgs-small"  [k4]  model.layers = ["mlp", "mlp", "mlp", "mlp"]
    """

    systems: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG...")]
    """Presets and TOML files."""
    data: tuple[Path, ...]
    """Dataset folders, one or more."""
    out: Path
    """The folder for all runs and the results; new, or one of the same comparison."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Each is a run of its own; the table shows mean and spread."""
    steps: int = 3000
    """The budget of each run in optimiser steps, whatever a preset says. Schedules that are parts of a run shrink with
    it; those in steps (sh_degree_interval, refine_start, reset_every, ema_steps) don't."""
    minutes: float | None = None
    """A run also ends after so many minutes. Learning rates fall over --steps, so choose these to be just reached."""
    size: int | None = None
    """Width in pixels of all images."""
    init_num_pts: int | None = None
    """Gaussians at the start, for all systems; left out: each its own."""
    max_gaussians: int | None = None
    """Gaussians at most, for all systems; left out: each its own."""
    threads: int = 1
    """Of each run."""
    jobs: int | None = None
    """Runs side by side; left out: as many as have their threads' cores. Times of runs side by side disturb each other
    somewhat; those of frames are taken at the end, one after the other."""
    ray: str | None = None
    """Train on a Ray cluster: `auto`, that of this machine (one is started where there is none), or its address. DATA
    and OUT must be seen by all its machines under the same names."""


Command = (
    Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Synthetic, tyro.conf.subcommand("synthetic")]
    | Annotated[Evaluate, tyro.conf.subcommand("eval")]
    | Annotated[Steps, tyro.conf.subcommand("steps")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `msdgs-train`; returns the exit code: 0 done, 2 wrong input, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return _run(_parse(arguments))
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        return EXIT_INTERRUPTED
    except MsdgsError as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        return EXIT_INVALID


def _run(command: Fit | Synthetic | Evaluate | Steps | View | Compare) -> int:
    match command:
        case Fit():
            return _fit(command)
        case Synthetic():
            return _synthetic(command)
        case Evaluate():
            return _evaluate(command)
        case Steps():
            return _steps(command)
        case View():
            return _view(command)
        case Compare():
            return _compare(command)


def _parse(arguments: Sequence[str]) -> Command:  # type: ignore[valid-type]
    if arguments[:1] == ["fit"]:
        return _parse_fit(arguments[1:])
    return tyro.cli(Command, args=arguments, prog="msdgs-train", description=__doc__)  # type: ignore[arg-type]


def _parse_fit(arguments: Sequence[str]) -> Fit:
    """Options change the settings of the preset, or of the run that is resumed, and those are what --help shows."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset")
    name = early.parse_known_args(arguments)[0].preset
    default = Fit(tyro.MISSING, tyro.MISSING, preset=name or DEFAULT, config=preset(name or DEFAULT))
    command = tyro.cli(Fit, args=arguments, prog="msdgs-train fit", default=default)
    if command.resume:
        if name is not None:
            raise InvalidInput("preset", "left out: a run goes on with the settings that it began with", name)
        from msdgs_train.engine.run import stored_config

        # parsed again with the run's own settings as defaults, so that only what is given now differs from them
        stored = Fit(command.data, command.run, config=stored_config(command.run))
        command = tyro.cli(Fit, args=arguments, prog="msdgs-train fit", default=stored)
    return command


def _fit(command: Fit) -> int:
    from msdgs_train.cli.progress import FitProgress, print_outcome
    from msdgs_train.engine.run import Observer, Observers, fit

    with contextlib.ExitStack() as stack:
        view = stack.enter_context(_training_view(command)) if command.viewer else None
        with FitProgress(console, command.config.steps) as progress:
            observers: list[Observer] = [progress, view] if view else [progress]
            outcome = fit(
                command.config,
                command.data,
                command.run,
                resume=command.resume,
                observer=Observers(*observers),
                tensorboard=command.tensorboard,
            )
        print_outcome(console, outcome, command.data, command.run)
        if view is not None and outcome.status != "interrupted":
            with contextlib.suppress(KeyboardInterrupt):
                console.print("the page stays, with the last model; Ctrl-C ends it")
                view.wait_for_interrupt()
    return EXIT_INTERRUPTED if outcome.status == "interrupted" else 0


@contextlib.contextmanager
def _training_view(command: Fit) -> Iterator["TrainingView"]:
    from msdgs_train.viewer.training_view import TrainingView

    with _viewer(command.viewer_host, command.viewer_port) as viewer:
        yield TrainingView(viewer, command.config.steps)


def _viewer(host: str, port: int) -> "Viewer":
    from msdgs_train.viewer.viewer import Viewer

    viewer = Viewer(host, port)
    console.print(f"look at {viewer.url}", soft_wrap=True)
    return viewer


def _synthetic(command: Synthetic) -> int:
    from msdgs_train.cli.progress import frame_progress
    from msdgs_train.datasets.synthetic.generate import generate

    with frame_progress(console, command.train_frames + command.test_frames) as progress:
        generate(
            command.out,
            size=command.size,
            train_frames=command.train_frames,
            test_frames=command.test_frames,
            seed=command.seed,
            progress=progress,
        )
    console.print(f"made {command.out}; next: msdgs-train fit {command.out} runs/first", soft_wrap=True)
    return 0


def _evaluate(command: Evaluate) -> int:
    from msdgs_train.cli.progress import frame_progress
    from msdgs_train.evaluation.evaluate import evaluate_run
    from msdgs_train.evaluation.report import notes, write_evaluation

    with frame_progress(console, 0) as progress:
        evaluation = evaluate_run(command.run, command.data, command.split, progress)
    paths = write_evaluation(command.run, evaluation)
    console.print(_table(evaluation))
    for note in notes(evaluation):
        console.print(note, soft_wrap=True, highlight=False)
    console.print("wrote " + ", ".join(map(str, paths)), soft_wrap=True)
    return 0


def _table(evaluation: "Evaluation") -> "Table":
    from msdgs_train.evaluation.report import HEADINGS, cells

    rows = [[j.name, f"{j.loaded.step:,}", *cells(evaluation, j.mean)] for j in evaluation.models]
    title = f"{evaluation.split}, mean of {len(evaluation.frames)} images"
    return _rich_table(["model", "step", *HEADINGS.values()], rows, names=1, title=title)


def _rich_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], *, names: int, title: str | None = None
) -> "Table":
    """Numbers are at the right of their columns, the first `names` columns at the left."""
    from rich.table import Table

    shown = Table(title=title)
    for i, heading in enumerate(headings):
        shown.add_column(heading, justify="left" if i < names else "right")
    for row in rows:
        shown.add_row(*row)
    return shown


def _steps(command: Steps) -> int:
    from msdgs_train.evaluation.layer_strip import write_steps

    images = write_steps(command.model, command.out, t=command.t, size=command.size, camera=command.camera)
    console.print(f"wrote {command.out}: k = 0 to {len(images) - 1}", soft_wrap=True)
    return 0


def _view(command: View) -> int:
    from msdgs_train.gaussians.model_file import load_model
    from msdgs_train.viewer.viewer import show_model

    loaded = load_model(command.model)
    with _viewer(command.host, command.port) as viewer, contextlib.suppress(KeyboardInterrupt):
        show_model(viewer, loaded, str(command.model))
        viewer.wait_for_interrupt()
    return 0


def _compare(command: Compare) -> int:
    from msdgs_serve.threads import thread_count
    from msdgs_train.cli.progress import ComparisonProgress
    from msdgs_train.comparison.matrix import Budget, make_runs, read_systems
    from msdgs_train.comparison.pools import processes, ray_tasks
    from msdgs_train.comparison.report import HEADINGS, table, write_comparison
    from msdgs_train.comparison.results import collect
    from msdgs_train.comparison.runner import train_all

    budget = Budget(
        command.steps, command.minutes, command.size, command.threads, command.init_num_pts, command.max_gaussians
    )
    runs = make_runs(read_systems(command.systems, budget), command.data, command.seeds, command.out)
    if command.jobs is not None and command.jobs < 1:
        raise InvalidInput("jobs", "1 or more", command.jobs)
    if command.ray is None:
        pool = processes(command.jobs or max(1, thread_count() // command.threads))
    else:
        pool = ray_tasks(command.ray, command.threads, command.jobs)
    with ComparisonProgress(console, len(runs)) as progress:
        complete = train_all(runs, pool, progress.ended)
    results = collect(runs)
    if results:
        paths = write_comparison(command.out, results, len(runs) - len(results))
        if console.is_terminal:
            console.print(_rich_table(HEADINGS, table(results), names=2))
        else:  # 80 columns would cut it
            console.print(paths[0].read_text(encoding="utf-8"), soft_wrap=True, markup=False, highlight=False)
        console.print("wrote " + ", ".join(map(str, paths)), soft_wrap=True)
    if not complete:
        console.print("interrupted; the same command goes on", soft_wrap=True)
        return EXIT_INTERRUPTED
    return 0 if len(results) == len(runs) else EXIT_INVALID


if __name__ == "__main__":
    raise SystemExit(main())
