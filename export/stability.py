"""`python export/stability.py model.pt`: whether float32, or less, shows what the model would show in float64."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

if __name__ == "__main__":  # as a file, from any folder: the checkout's packages, not this folder's modules
    folder = Path(__file__).resolve().parent
    sys.path[:] = [str(folder.parent), *(p for p in sys.path if Path(p or ".").resolve() != folder)]

try:
    import tyro
    from rich.console import Console
    from rich.progress import Progress

    if find_spec("torch") is None:  # not loaded yet: --help is printed at once
        raise ModuleNotFoundError(name="torch")
except ModuleNotFoundError as error:
    raise SystemExit(f"stability.py needs {error.name}, which serving alone doesn't: pip install '.[export]'") from None

from msdgs_serve.scene.errors import InvalidInput, MsdgsError

UNSTABLE = 3
"""Exit status if the model is unstable; 1 is an error."""


def main(
    model: Annotated[Path, tyro.conf.Positional],
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None,
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None,
    times: int = 20,
    min_psnr: float = 50.0,
) -> int:
    """Measure how stable a trained model's deformation is in float32 and in less.

    A chain of layers multiplies round-off: each layer sees the means that the layers before it have moved. For
    Gaussians spread over the scene, at times between the frames as well, this measures how much a small displacement
    grows on its way, and how far the pose is off from float64 in float32, bfloat16 and float16; then it draws the worst
    times in each. docs/stability.md explains the table.

    Type this:

    python export/stability.py runs/ball/model.pt --plot stability.png

    The exit status is 0 if float32 is as good as float64, 3 if it isn't, and 1 if the file can't be read.

    Args:
        model: The `model.pt` of a training run.
        json: Write the numbers to this file.
        plot: Draw growth, amplification and errors into this PNG.
        times: The number of times to compare at, both ends of the scene's time range among them.
        min_psnr: PSNR in dB of the worst frame against float64, below which an error counts as visible.
    """
    console = Console(soft_wrap=True, highlight=False)
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        return _report(model, json, plot, times, min_psnr, console, errors)
    except KeyboardInterrupt:
        errors.print("stopped; nothing was written", markup=False)
        return 130
    except (MsdgsError, OSError) as error:
        errors.print(f"error: {error}", style="red", markup=False)
        return 1


def _report(
    model: Path, json: Path | None, plot: Path | None, times: int, min_psnr: float, console: Console, errors: Console
) -> int:
    if times < 2:
        raise InvalidInput("times", "2 or more", times)
    if not 0 < min_psnr < 100:
        raise InvalidInput("min_psnr", "between 0 and 100 dB", min_psnr)
    with errors.status("loading torch and the kernels"):
        from export.measure.stability import assess  # heavy: seconds, so not before --help
        from export.precision.formats import FORMATS
        from export.precision.show import draw, print_report, write_json
        from msdgs_train.gaussians.model_file import load_model
    loaded = load_model(model)
    with Progress(console=errors, transient=True) as progress:
        task = progress.add_task("comparing with float64", total=times)
        report = assess(
            loaded.model,
            loaded.scene,
            min_psnr=min_psnr,
            times=times,
            formats=FORMATS,
            on_time=lambda: progress.advance(task),
        )
    print_report(report, console)
    if json is not None:
        write_json(report, json)
    if plot is not None:
        draw(report, plot)
    return 0 if report.stable else UNSTABLE


if __name__ == "__main__":
    sys.exit(tyro.cli(main, config=(tyro.conf.FlagConversionOff,)))
