"""`python export/to_onnx.py model.pt`: one ONNX scene file from a trained model, as fast as its error may be."""

import sys
from importlib.util import find_spec
from pathlib import Path

if __name__ == "__main__":  # as a file, from any folder: the checkout's packages, not this folder's modules
    folder = Path(__file__).resolve().parent
    sys.path[:] = [str(folder.parent), *(p for p in sys.path if Path(p or ".").resolve() != folder)]

try:
    import tyro
    from rich.console import Console

    if find_spec("torch") is None:  # not loaded yet: --help is printed at once
        raise ModuleNotFoundError(name="torch")
except ModuleNotFoundError as error:
    raise SystemExit(f"to_onnx.py needs {error.name}, which serving alone does not: pip install '.[export]'") from None

from export.options import ExportOptions
from msdgs_serve.scene.errors import MsdgsError


def main(options: ExportOptions) -> int:
    """Export, and print what happens or what is wrong. Returns the exit status."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        with console.status("loading torch and onnxruntime"):
            from export.importers.command import model_or_import  # slow to import: not before --help
            from export.jobs.command import export
        with model_or_import(options.model, options.format, options.scene_file, console) as model:
            if model is not None:
                export(model, options, console)
    except KeyboardInterrupt:
        console.print(f"stopped; {options.scene_file} is unchanged", markup=False)
        return 130
    except (MsdgsError, OSError) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(ExportOptions)))
