"""`python export/to_onnx.py model.pt`: one ONNX scene file from a trained model, compared with it before it counts."""

import sys
from pathlib import Path
from typing import Annotated

if __name__ == "__main__":  # as a file, from any folder: the checkout's packages, not this folder's modules
    folder = Path(__file__).resolve().parent
    sys.path[:] = [str(folder.parent), *(p for p in sys.path if Path(p or ".").resolve() != folder)]

try:
    import torch  # noqa: F401
    import tyro
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table
except ModuleNotFoundError as error:
    raise SystemExit(f"to_onnx.py needs {error.name}, which serving alone does not: pip install '.[export]'") from None

from msdgs_serve.scene.errors import MsdgsError


def main(
    model: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
    tolerance: float = 1e-4,
    times: int = 50,
) -> int:
    """Turn a trained model into one self-contained ONNX scene file (contract msdgs/1, described in docs/contract.md).

    The scale modulation is computed once and stored, SH and opacities are stored as they are drawn, and the
    deformation becomes a graph: t and ids in, posed Gaussians out. The written file is then loaded in onnxruntime and
    compared with the model in float32 and float64 at many times, both ends and between frames. Only a file that
    passes replaces an older one.

    Type this:

    python export/to_onnx.py runs/ball/model.pt -o scenes/ball.onnx

    msdgs-serve scenes/ball.onnx

    Args:
        model: The `model.pt` of a training run.
        output: The scene file to write; by default beside the model, ending in .onnx.
        tolerance: Largest relative error allowed for positions, rotations and scales.
        times: At how many times to compare.
    """
    output = model.with_suffix(".onnx") if output is None else output
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        _export(model, output, tolerance, times, console)
    except KeyboardInterrupt:
        console.print(f"stopped; {output} is as it was", markup=False)
        return 130
    except (MsdgsError, OSError) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    return 0


def _export(model: Path, output: Path, tolerance: float, times: int, console: Console) -> None:
    with console.status("loading torch and onnxruntime"):
        from export.write import export_scene  # heavy: a second or more, so not before --help
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("comparing with the model", total=times)
        exported = export_scene(model, output, tolerance=tolerance, times=times, on_time=lambda: progress.advance(task))
    error = exported.measured_error
    table = Table("max error against the model", "float64", "float32", box=None)
    for name, how in (
        ("means", "relative to the scene's size"),
        ("quats", "absolute"),
        ("scales", "relative to each Gaussian's size"),
    ):
        table.add_row(f"{name}, {how}", f"{error[name]:.2e}", f"{error['against_float32'][name]:.2e}")
    console.print(table)
    if error["unstable"]["count"]:
        console.print(
            f"{error['unstable']['count']:,} Gaussians left out of these errors: there the model's own float32 differs "
            f"from its float64. The worst is off by {error['unstable']['error']:.2e}"
        )
    console.print(
        f"{error['times']} times, tolerance {tolerance:g}: passed\n"
        f"{exported.path}: {exported.size / 1e6:.2f} MB, {exported.moving_count:,} moving and "
        f"{exported.static_count:,} static Gaussians, {len(exported.metadata.layers)} layers"
    )


if __name__ == "__main__":
    sys.exit(tyro.cli(main, config=(tyro.conf.FlagConversionOff,)))
