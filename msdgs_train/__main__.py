"""`msdgs-train` and `python -m msdgs_train`: the command line, or a message that names a missing package."""

import sys

from msdgs_serve.process import EXIT_INVALID, begin


def main() -> int:
    """Entry point; returns the exit code."""
    begin()
    try:
        from msdgs_train.cli.main import main
    except ModuleNotFoundError as error:
        print(
            f"msdgs-train needs {error.name}, which serving alone does not: pip install 'msdgs[train]'", file=sys.stderr
        )
        return EXIT_INVALID
    return main()


if __name__ == "__main__":
    raise SystemExit(main())
