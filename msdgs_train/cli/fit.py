"""`msdgs-train fit`."""

import argparse
import contextlib
import inspect
import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.console import EXIT_INTERRUPTED, console
from msdgs_train.cli.parts import PARTS
from msdgs_train.cli.view import open_viewer
from msdgs_train.datasets.config import DataConfig
from msdgs_train.density.config import DensityConfig
from msdgs_train.engine.config import LoggingConfig, OptimizerConfig, RunConfig, TrainConfig
from msdgs_train.engine.curriculum_config import CurriculumConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.losses.config import LossConfig
from msdgs_train.systems.registry import DEFAULT, preset, systems

if TYPE_CHECKING:
    from msdgs_train.viewer.training_view import TrainingView

HELP_ALL = "--help-all"


@dataclass(frozen=True)
class Fit:
    """Train on a folder of images; RUN gets config.json, run.json, metrics.jsonl, curve.png, renders/, checkpoint.pt,
    model.pt (the last) and best.pt (of the highest PSNR on held-out images).

    Ctrl-C finishes the step, saves a checkpoint and stops. The same command with --resume continues from there, with
    the same bits as if it had never stopped; more --steps, another --max-minutes and the like may be given then.

    A first look, in a few minutes:  msdgs-train fit data/scene runs/first --size 200 --steps 3000

    The paper's system with two layers:  msdgs-train fit data/scene runs/paper --preset msdgs-mlp --layers mlp mlp

    All settings, with the values of a preset:  msdgs-train fit --preset deformgs --help-all
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """A dataset folder in the layout of D-NeRF, nerfstudio, COLMAP, Neu3D or HyperNeRF, detected by its files."""
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of this run; new, or one to --resume."""
    preset: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT
    """A system and its settings; other options change them."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Continue the run in RUN, with the settings it was begun with."""
    tensorboard: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also write metrics and held-out renderings to RUN/tensorboard. Needs: pip install 'msdgs[tensorboard]'"""
    viewer: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Open a page that shows the model while it is trained, from all around, at any time, after each layer; it stays
    when the run is over, until Ctrl-C. Needs: pip install 'msdgs[viewer]'"""
    viewer_port: int = 8080
    """Port of that page; one of the next if it is taken. 0 takes a free one."""
    viewer_host: str = "127.0.0.1"
    """Address that it listens on; 0.0.0.0 for all networks, from which anyone may then pause the run."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def execute(self) -> int:
        """Train, with a progress bar."""
        from msdgs_train.cli.progress import FitProgress, print_outcome
        from msdgs_train.engine.run import Observer, Observers, fit

        with contextlib.ExitStack() as stack:
            view = stack.enter_context(_training_view(self)) if self.viewer else None
            with FitProgress(console, self.config.run.steps) as progress:
                observers: list[Observer] = [progress, view] if view else [progress]
                outcome = fit(
                    self.config,
                    self.data,
                    self.run,
                    resume=self.resume,
                    observer=Observers(*observers),
                    tensorboard=self.tensorboard,
                )
            print_outcome(console, outcome, self.data, self.run)
            if view is not None and outcome.status != "interrupted":
                with contextlib.suppress(KeyboardInterrupt):
                    console.print("the page stays, with the last model; Ctrl-C ends it")
                    view.wait_for_interrupt()
        return EXIT_INTERRUPTED if outcome.status == "interrupted" else 0


@dataclass(frozen=True)
class _CommonSettings:
    """The groups of settings that the short help shows."""

    run: RunConfig
    data: DataConfig
    model: ModelConfig
    curriculum: tyro.conf.Suppress[CurriculumConfig]
    density: tyro.conf.Suppress[DensityConfig]
    loss: tyro.conf.Suppress[LossConfig]
    optimizer: tyro.conf.Suppress[OptimizerConfig]
    logging: tyro.conf.Suppress[LoggingConfig]


@dataclass(frozen=True)
class _ShortHelp(Fit):
    config: Annotated[_CommonSettings, tyro.conf.arg(name="")] = tyro.MISSING  # type: ignore[assignment]


def parse_fit(arguments: Sequence[str]) -> Fit:
    """Options change the settings of the preset, or of the run that is resumed, and those are what --help shows."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset")
    name = early.parse_known_args(arguments)[0].preset
    config = preset(name or DEFAULT)
    if {"-h", "--help"} & set(arguments):
        shown = _CommonSettings(**{group: getattr(config, group) for group in _CommonSettings.__dataclass_fields__})
        _cli(_ShortHelp, ["--help"], _ShortHelp(tyro.MISSING, tyro.MISSING, preset=name or DEFAULT, config=shown))  # type: ignore[arg-type]
    arguments = ["--help" if argument == HELP_ALL else argument for argument in arguments]
    command = _cli(Fit, arguments, Fit(tyro.MISSING, tyro.MISSING, preset=name or DEFAULT, config=config))
    if command.resume:
        if name is not None:
            raise InvalidInput("preset", "not given: a resumed run keeps the settings that it began with", name)
        from msdgs_train.engine.run import stored_config

        # parsed again with the run's own settings as defaults, so that only what is given now differs from them
        command = _cli(Fit, arguments, Fit(command.data, command.run, config=stored_config(command.run)))
    return command


def _cli(kind: type[Fit], arguments: Sequence[str], default: Fit) -> Fit:
    names = "\n".join(f"  {entry.name}: {entry.description}" for entry in systems().values())
    description = (
        f"{inspect.cleandoc(Fit.__doc__ or '')}\n\nPresets:\n{names}\n\n{HELP_ALL} shows the settings of all groups."
    )
    errors = io.StringIO()
    try:
        with PARTS, contextlib.redirect_stderr(errors):
            return tyro.cli(
                kind,
                args=arguments,
                prog="msdgs-train fit",
                default=default,
                description=description,
                config=(tyro.conf.OmitArgPrefixes,),
            )
    except SystemExit as end:
        if (refused := _refused_setting(end)) is not None:  # tyro has drawn a box; every command prints one line
            raise refused from None
        sys.stderr.write(errors.getvalue())
        raise


def _refused_setting(end: SystemExit) -> InvalidInput | None:
    """The error of a setting for which tyro ends the program; None if it is another reason."""
    cause: BaseException | None = end
    while cause is not None and not isinstance(cause, InvalidInput):
        cause = cause.__context__
    return cause


@contextlib.contextmanager
def _training_view(command: Fit) -> Iterator["TrainingView"]:
    from msdgs_train.viewer.training_view import TrainingView

    with open_viewer(command.viewer_host, command.viewer_port) as viewer:
        yield TrainingView(viewer, command.config.run.steps)
