"""`msdgs-stability`: the error of float32 against float64."""

from pathlib import Path
from typing import Annotated

from msdgs_export.command_line import Console, run, tyro
from msdgs_export.options import require_writable
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.settings import optional

UNSTABLE = 3
"""Exit status if the model is unstable; 2 is an error."""


def main(
    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")],
    json: Annotated[Path | None, optional("PATH")] = None,
    times: int = 20,
    min_psnr: Annotated[float, tyro.conf.arg(metavar="DB")] = 50.0,
) -> int:
    """Measure how stable a trained model's deformation is in float32.

    A chain of layers multiplies round-off: each layer reads the means that the layers before it have moved. For
    Gaussians spread over the scene, also at times between the frames, this measures how much a small displacement
    grows from layer to layer, and the errors of poses in float32 against float64. Then it renders the worst times in
    both. docs/stability.md explains the table.

    Type this:

    msdgs-stability runs/ball/model.pt

    The exit status is 0 if float32 is as good as float64, 3 if it isn't, and 2 if the file can't be read.

    Args:
        model: The `model.pt` of a training run.
        json: Write the numbers to this file.
        times: The number of times to compare at, both ends of the scene's time range among them.
        min_psnr: PSNR in dB of the worst frame against float64, below which an error counts as visible.
    """

    def assessed(messages: Console) -> int:
        if times < 2:
            raise InvalidInput("times", "2 or more", times)
        if not 0 < min_psnr < 100:
            raise InvalidInput("min_psnr", "between 0 and 100 dB", min_psnr)
        if json is not None:
            require_writable("json", json, model)
        with messages.status("loading torch and the kernels"):
            from msdgs_export.precision.show import assess_and_show  # slow to import: not before --help
        report = assess_and_show(model, times, min_psnr, json, messages)
        return 0 if report.stable else UNSTABLE

    return run(assessed, "stopped; nothing was written")


def command() -> int:
    """Run the command line; returns the exit status."""
    return tyro.cli(main)
