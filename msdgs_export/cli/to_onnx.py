"""`msdgs-export`: one ONNX scene file from a trained model, as fast as its error may be."""

import sys

from msdgs_export.command_line import Console, run, tyro
from msdgs_export.options import ExportOptions, with_values_of_up
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.metadata import MAX_NUMBER


def main(options: ExportOptions) -> int:
    """Export, and print progress and errors. Returns the exit status."""

    def exported(console: Console) -> None:
        with console.status("loading torch and onnxruntime"):
            from msdgs_export.importers.command import model_or_import  # slow to import: not before --help
            from msdgs_export.importers.scene import changed_metadata
            from msdgs_export.jobs.command import export
        if options.duration is not None and not 0 < options.duration <= MAX_NUMBER:
            raise InvalidInput("duration", "seconds above 0", options.duration)
        with model_or_import(options, console) as model:
            if model is not None:
                export(model, options, console)
        if options.duration is not None:
            changed_metadata(options.scene_file, duration=options.duration)

    return run(exported, "stopped; existing files are complete")


def command() -> int:
    """Run the command line; returns the exit status."""
    return main(tyro.cli(ExportOptions, args=with_values_of_up(sys.argv[1:])))
