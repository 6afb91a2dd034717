"""`msdgs-export`: one ONNX scene file from a trained model, as fast as its error may be."""

import sys

from msdgs_export.command_line import Console, run, tyro
from msdgs_export.options import ExportOptions, with_values_of_up


def main(options: ExportOptions) -> int:
    """Export, and print progress and errors. Returns the exit status."""

    def exported(console: Console) -> None:
        with console.status("loading torch and onnxruntime"):
            from msdgs_export.cli.export import export_or_import  # slow to import: not before --help
        export_or_import(options, console)

    return run(exported, "stopped; existing files are complete")


def command() -> int:
    """Run the command line; returns the exit status."""
    return main(tyro.cli(ExportOptions, args=with_values_of_up(sys.argv[1:])))
