"""`python export/to_onnx.py model.pt`: one ONNX scene file from a trained model, as fast as its error may be."""

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

    if find_spec("torch") is None:  # not loaded yet: --help is printed at once
        raise ModuleNotFoundError(name="torch")
except ModuleNotFoundError as error:
    raise SystemExit(f"to_onnx.py needs {error.name}, which serving alone does not: pip install '.[export]'") from None

from msdgs_serve.scene.errors import MsdgsError

Off = Annotated[bool, tyro.conf.FlagCreatePairsOff]


def main(
    model: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
    kind: Annotated[str | None, tyro.conf.arg(name="from", metavar="KIND")] = None,
    min_psnr: float = 50.0,
    plan: str | None = None,
    quick: Off = False,
    data: Path | None = None,
    no_unseen: Off = False,
    no_still: Off = False,
    no_layers: Off = False,
    no_heads: Off = False,
    no_modulation: Off = False,
    no_bands: Off = False,
    tolerance: float = 1e-4,
    times: int = 50,
) -> int:
    """Turn a trained model into one self-contained ONNX scene file (contract msdgs/1, described in docs/contract.md).

    Ways to compute the motion (plans) and things that the scene could do without (trimming) are tried together. Frames
    of each are compared with those of the exact network in float64, and timed. The fastest whose worst frame is within
    --min-psnr is written, and beside it a report as .json, .md and .png: error against run time.

    Type this:

    python export/to_onnx.py runs/ball/model.pt -o scenes/ball.onnx

    msdgs-serve scenes/ball.onnx

    Scenes of others are recognised by what is in them: INRIA's and SuperSplat's .ply, .spz, SOG, .splat and .ksplat,
    numbered sequences of them, and runs of Deformable-3D-Gaussians and 4DGaussians (docs/formats.md):

    python export/to_onnx.py garden.ply -o scenes/garden.onnx

    In seconds instead of minutes, all layers as trained, without what isn't seen:

    python export/to_onnx.py runs/ball/model.pt --quick

    Args:
        model: The `model.pt` of a training run, or a file or folder of another program.
        output: The scene file to write; by default beside the model, ending in .onnx.
        kind: What the input is, where it isn't recognised: model, ply, spz, spz:unturned, sog, splat, ksplat, sequence,
            sequence:blend, sequence:switch, deformgs, 4dgs.
        min_psnr: PSNR in dB that the worst frame must have against the exact network; differences are invisible from
            about 50. Lower is faster and less exact.
        plan: Write this plan, without a sweep: network, prefix:2, ...; an unknown one lists all.
        quick: No sweep and no report: the plan `network`, trimmed.
        data: The folder of the images. Its training cameras are measured at, and held-out images compared.
        no_unseen: Keep Gaussians that never contribute to a frame.
        no_still: Keep in the graph Gaussians that never move visibly.
        no_layers: Keep layers whose weighted step is invisible.
        no_heads: Keep heads that change nothing.
        no_modulation: Keep scale modulation that is 1.
        no_bands: Keep SH bands that change nothing.
        tolerance: Largest relative error of positions, rotations and scales that the plan `network` may have against
            the layers that it computes.
        times: At how many times to compare these.
    """
    output = model.with_suffix(".onnx") if output is None else output
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    switched_off = {
        "unseen": no_unseen,
        "still": no_still,
        "layers": no_layers,
        "heads": no_heads,
        "modulation": no_modulation,
        "bands": no_bands,
    }
    try:
        with console.status("loading torch and onnxruntime"):
            from export.importers.command import model_or_import
            from export.jobs.command import Settings, export  # heavy: a second or more, so not before --help
        off = frozenset(rule for rule, is_off in switched_off.items() if is_off)
        plan = "network" if quick and plan is None else plan
        with model_or_import(model, kind, output, console) as source:
            if source is not None:
                export(Settings(source, output, min_psnr, plan, data, off, tolerance, times), console)
    except KeyboardInterrupt:
        console.print(f"stopped; {output} is as it was", markup=False)
        return 130
    except (MsdgsError, OSError) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
