"""`msdgs-convert`: conversion of a scene file to formats of other viewers."""

from msdgs_export.command_line import Console, run, tyro
from msdgs_export.options import ConvertOptions


def main(options: ConvertOptions) -> int:
    """Convert, and print progress and errors. Returns the exit status."""

    def converted(console: Console) -> None:
        with console.status("loading"):
            from msdgs_export.exporters.command import convert  # slow to import: not before --help
        convert(options, console)

    return run(converted, "stopped; existing files are complete")


def command() -> int:
    """Run the command line; returns the exit status."""
    return main(tyro.cli(ConvertOptions))
