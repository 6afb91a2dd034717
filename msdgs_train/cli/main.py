"""`msdgs-train`: train dynamic Gaussians on images of a moving scene, evaluate and view them."""

import argparse
import sys
from collections.abc import Sequence

import tyro
from rich.console import Console

from msdgs_serve.process import EXIT_INTERRUPTED, EXIT_INVALID
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.writing import in_words
from msdgs_train.cli.capture import Capture
from msdgs_train.cli.compare import Compare
from msdgs_train.cli.evaluate import Eval
from msdgs_train.cli.fit import Fit, parse_fit
from msdgs_train.cli.steps import Steps
from msdgs_train.cli.synthetic import Synthetic
from msdgs_train.cli.view import View
from msdgs_train.layers.plugins import add_plugin

Commands = Fit | Capture | Synthetic | Eval | Steps | View | Compare
"""Each command has the name of its class in lower case."""

EPILOG = "--plugin MODULE, for any command: a module or Python file that registers layers or systems (repeatable)."


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `msdgs-train`; returns the exit code: 0 success, 2 invalid input, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return _parse(_without_plugins(arguments)).execute()
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        return EXIT_INTERRUPTED
    except (MsdgsError, OSError) as error:
        Console(stderr=True).print(
            f"error: {in_words(error)}", style="red", markup=False, highlight=False, soft_wrap=True
        )
        return EXIT_INVALID


def _without_plugins(arguments: Sequence[str]) -> list[str]:
    """Import the modules of `--plugin`, before options that depend on their systems; returns the other arguments."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--plugin", action="append", default=[])
    known, rest = early.parse_known_args(arguments)
    for name in known.plugin:
        add_plugin(name)
    return rest


def _parse(arguments: Sequence[str]) -> Commands:
    if arguments[:1] == ["fit"]:
        return parse_fit(arguments[1:])
    description = f"{__doc__}\n\n{EPILOG}"
    return tyro.cli(Commands, args=arguments, prog="msdgs-train", description=description)  # type: ignore[arg-type]


if __name__ == "__main__":
    raise SystemExit(main())
