"""`msdgs-train`: fit a moving scene to photographs, or make a synthetic one to try it on."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.config import TrainConfig

EXIT_INVALID = 2
EXIT_INTERRUPTED = 130  # as a shell reports a program that Ctrl-C has stopped

console = Console()


@dataclass(frozen=True)
class Fit:
    """Train on a folder of photographs; RUN gets config.json, metrics.jsonl, curve.png, renders/, checkpoint.pt and
    model.pt.

    Ctrl-C finishes the step, saves a checkpoint and stops. The same command with --resume goes on from there, with
    the same bits as if it had never stopped; more --steps, another --max-minutes and the like may be given then.

    A first look, in a few minutes:  msdgs-train fit data/scene runs/first --size 200 --steps 3000
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """A dataset folder; D-NeRF layout: transforms_train.json, transforms_test.json and PNGs."""
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of this run; new, or one to --resume."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the run in RUN, with the settings it was begun with."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)


@dataclass(frozen=True)
class Synthetic:
    """Make a small moving scene with known motion, ray-marched into D-NeRF layout. No downloads, a few seconds.

    Example:  msdgs-train synthetic data/toy && msdgs-train fit data/toy runs/toy --steps 2000
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder to make."""
    size: int = 128
    """Width and height of the photographs in pixels."""
    train_frames: int = 64
    """At evenly spaced times, from all around."""
    test_frames: int = 12
    """Held out: at times between, from one smooth turn around the scene."""
    seed: int = 0
    """Of the cameras and times."""


Command = Annotated[Fit, tyro.conf.subcommand("fit")] | Annotated[Synthetic, tyro.conf.subcommand("synthetic")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `msdgs-train`; returns the exit code: 0 done, 2 wrong input, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        command = _parse(arguments)
        return _synthetic(command) if isinstance(command, Synthetic) else _fit(command)
    except MsdgsError as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False, highlight=False)
        return EXIT_INVALID


def _parse(arguments: Sequence[str]) -> Fit | Synthetic:
    command = tyro.cli(Command, args=arguments, prog="msdgs-train", description=__doc__)  # type: ignore[arg-type]
    if isinstance(command, Fit) and command.resume:
        from msdgs_train.fit import stored_config

        # parsed again with the run's own settings as defaults, so that only what is given now differs from them
        stored = Fit(command.data, command.run, config=stored_config(command.run))
        command = tyro.cli(Fit, args=arguments[1:], prog="msdgs-train fit", default=stored)
    return command


def _fit(command: Fit) -> int:
    from msdgs_train.fit import fit
    from msdgs_train.progress import FitProgress

    with FitProgress(console, command.config.steps) as progress:
        outcome = fit(command.config, command.data, command.run, resume=command.resume, observer=progress)
    console.print(
        f"{outcome.status} at step {outcome.step:,}, {outcome.gaussians:,} Gaussians, {outcome.seconds:.0f} s"
    )
    for split, quality in outcome.qualities.items():
        console.print(f"{split:>5}: PSNR {quality.psnr:.2f} dB, SSIM {quality.ssim:.4f}")
    console.print(f"model: {command.run / 'model.pt'}", soft_wrap=True)
    if outcome.status != "finished":
        more = " --max-minutes None" if outcome.status == "out of time" else ""
        console.print(f"go on with: msdgs-train fit {command.data} {command.run} --resume{more}", soft_wrap=True)
    return EXIT_INTERRUPTED if outcome.status == "interrupted" else 0


def _synthetic(command: Synthetic) -> int:
    from msdgs_train.datasets.synthetic import generate
    from msdgs_train.progress import frame_progress

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


if __name__ == "__main__":
    raise SystemExit(main())
