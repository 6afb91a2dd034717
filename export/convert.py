"""`python export/convert.py scene.onnx OUT`: conversion of a scene file to formats of other viewers."""

import sys
from os.path import dirname, realpath

if __name__ == "__main__":  # as a file, from any folder: the checkout's packages, not this folder's modules
    folder = dirname(realpath(__file__))
    sys.path[:] = [dirname(folder), *(path for path in sys.path if realpath(path or ".") != folder)]

    from msdgs_serve.process import begin

    begin()

from export.command_line import Console, run, tyro
from export.options import ConvertOptions


def main(options: ConvertOptions) -> int:
    """Convert, and print progress and errors. Returns the exit status."""

    def converted(console: Console) -> None:
        with console.status("loading"):
            from export.exporters.command import convert  # slow to import: not before --help
        convert(options, console)

    return run(converted, "stopped; existing files are complete")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(ConvertOptions)))
