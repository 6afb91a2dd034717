"""`msdgs-train fit`."""

import argparse
import contextlib
import inspect
import io
import sys
from collections.abc import Container, Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from msdgs_serve.process import EXIT_INTERRUPTED
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.cli.console import console
from msdgs_train.cli.parts import PARTS
from msdgs_train.cli.view import open_viewer
from msdgs_train.engine.config import TrainConfig
from msdgs_train.settings import Flag
from msdgs_train.systems.registry import DEFAULT, preset, systems
from msdgs_train.systems.unused import refuse_unused

HELP_ALL = "--help-all"
COMMON = {
    "run": ("steps", "batch_size", "threads", "device", "minutes", "seed"),
    "data": ("size", "time_from", "background"),
    "density": ("init_num_pts", "max_gaussians"),
    "model": ("layers", "support", "sh_degree", "embedding_dim"),
}
"""Settings that --help shows, by group; --help-all shows all."""
RARE = ("viewer_port", "viewer_host")
"""Options of the command that only --help-all shows."""


@dataclass(frozen=True)
class Fit:
    """Train on a folder of images. RUN gets config.json, metrics.jsonl, curve.png, renders/, checkpoint.pt, model.pt
    (last step) and best.pt (highest PSNR on held-out images).

    Ctrl-C saves a checkpoint and stops; --resume continues with the same bits, also with other --steps if that moves no
    phase of the schedule.

    A first result in minutes:  msdgs-train fit data/scene runs/first --size 200 --steps 3000

    The paper's MLP system:  msdgs-train fit data/scene runs/paper --preset msdgs-mlp

    All settings of a preset:  msdgs-train fit --preset deformgs --help-all

    Layers and systems of your own:  msdgs-train fit data/scene runs/own --plugin my_plugin.py --preset my-system
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """A dataset in the layout of D-NeRF, nerfstudio, COLMAP, Neu3D or HyperNeRF."""
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The folder of the run: new, or one to --resume."""
    preset: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT
    """System and settings; other options change them."""
    resume: Flag = False
    """Continue the run in RUN with its own settings."""
    tensorboard: Flag = False
    """Also write events to RUN/tensorboard; needs msdgs[tensorboard]."""
    viewer: Flag = False
    """Show the model in a browser while it trains, and afterwards until Ctrl-C; needs msdgs[viewer]."""
    viewer_port: int = 8080
    """Port of the viewer; the next free one if it is taken, any free one if 0."""
    viewer_host: str = "127.0.0.1"
    """Address of the viewer; 0.0.0.0: all networks, from which anyone may then pause the run."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def execute(self) -> int:
        """Train with a progress bar; returns the exit code."""
        from msdgs_train.cli.fit_progress import FitProgress, print_result
        from msdgs_train.engine.observer import Observers
        from msdgs_train.engine.run import fit

        progress = FitProgress(self.config.run.steps)
        with contextlib.ExitStack() as stack:
            view, observer = None, progress
            if self.viewer:
                from msdgs_train.viewer.training_view import TrainingView

                viewer = stack.enter_context(open_viewer(self.viewer_host, self.viewer_port))
                view = TrainingView(viewer, self.config.run.steps)
                observer = Observers(progress, view)
            with progress:
                result = fit(
                    self.config,
                    self.data,
                    self.run,
                    resume=self.resume,
                    observer=observer,
                    tensorboard=self.tensorboard,
                )
            print_result(result, self.data, self.run, progress.elements)
            if view is not None and result.status != "interrupted":
                with contextlib.suppress(KeyboardInterrupt):
                    console.print("the viewer shows the last model; Ctrl-C closes it")
                    view.wait_for_interrupt()
        return EXIT_INTERRUPTED if result.status == "interrupted" else 0


def parse_fit(arguments: Sequence[str]) -> Fit:
    """Parse the arguments of `fit`. Options change the settings of the preset, or of the run that is resumed."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset")
    name = early.parse_known_args(arguments)[0].preset
    default = Fit(tyro.MISSING, tyro.MISSING, preset=name or DEFAULT, config=preset(name or DEFAULT))
    if {"-h", "--help"} & set(arguments):
        _cli(["--help"], _short_help(default))
    arguments = ["--help" if argument == HELP_ALL else argument for argument in arguments]
    command = _cli(arguments, default)
    if command.resume:
        if name is not None:
            raise InvalidInput("preset", "not given: a resumed run keeps its settings", name)
        from msdgs_train.engine.run_record import stored_config

        # parsed again with the run's own settings as defaults, so that only the given options change them
        default = Fit(command.data, command.run, config=stored_config(command.run))
        command = _cli(arguments, default)
    refuse_unused(default.config, command.config)
    return command


def _cli(arguments: Sequence[str], default: Fit) -> Fit:
    names = "\n".join(f"  {entry.name}: {entry.description}" for entry in systems().values())
    description = f"{inspect.cleandoc(Fit.__doc__ or '')}\n\nPresets:\n{names}"
    errors = io.StringIO()
    try:
        with PARTS, contextlib.redirect_stderr(errors):
            return tyro.cli(
                type(default),
                args=arguments,
                prog="msdgs-train fit",
                default=default,
                description=description,
                config=(tyro.conf.OmitArgPrefixes,),
            )
    except SystemExit as end:
        cause: BaseException | None = end
        while cause is not None and not isinstance(cause, InvalidInput):
            cause = cause.__context__
        if cause is not None:  # of a setting: reported in one line, as by the other commands, instead of tyro's box
            raise cause from None
        sys.stderr.write(errors.getvalue())
        raise


def _short_help(command: Fit) -> Any:
    """Return the same command, of a type that hides rarely used options in its help."""
    config = command.config
    common = COMMON | {"own": config.own.names()}
    groups = {item.name: _hiding(getattr(config, item.name), common.get(item.name, ())) for item in fields(config)}
    kinds = [(name, type(group)) for name, group in groups.items()]
    settings = make_dataclass("Settings", kinds, frozen=True)(**groups)
    own = [item.name for item in fields(command) if item.name not in RARE]
    return _hiding(command, own, config=settings)


def _hiding(options: Any, shown: Container[str], **replaced: Any) -> Any:
    """Return a copy of a dataclass, of a type that hides all fields but `shown` in the help; fields in `replaced` get
    another type and value."""
    kind = type(options)
    values = {item.name: getattr(options, item.name) for item in fields(kind)} | replaced
    changed = [(name, Annotated[type(value), tyro.conf.arg(name="")], tyro.MISSING) for name, value in replaced.items()]
    changed += [
        (name, tyro.conf.Suppress[hint], tyro.MISSING)
        for name, hint in get_type_hints(kind, include_extras=True).items()
        if name in values and name not in shown
    ]
    short = make_dataclass(kind.__name__, changed, bases=(kind,), frozen=True, namespace={"__doc__": kind.__doc__})
    return short(**values)
