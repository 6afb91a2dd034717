"""Common parts of the commands: a check for packages that serving doesn't need, and messages for errors."""

import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from msdgs_serve.process import EXIT_INTERRUPTED, EXIT_INVALID
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.writing import in_words

try:
    import tyro
    from rich.console import Console

    if find_spec("torch") is None:  # not imported yet, so that --help is printed at once
        raise ModuleNotFoundError(name="torch")
except ModuleNotFoundError as error:
    needed = f"{Path(sys.argv[0]).name} needs {error.name}, which serving alone doesn't"
    print(f"{needed}: pip install 'msdgs[export]'", file=sys.stderr)
    raise SystemExit(EXIT_INVALID) from None

__all__ = ["Console", "run", "tyro"]


def run(command: Callable[[Console], int | None], on_interrupt: str) -> int:
    """Run a command with a console for messages; returns its exit status: 2 after an error, 130 after Ctrl-C."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        return command(console) or 0
    except KeyboardInterrupt:
        console.print(on_interrupt, markup=False)
        return EXIT_INTERRUPTED
    except (MsdgsError, OSError) as error:
        console.print(f"error: {in_words(error)}", style="red", markup=False)
        return EXIT_INVALID
