"""`python export/convert.py scene.onnx OUT`: a scene file in the formats of other viewers."""

import sys
from pathlib import Path
from typing import Annotated

if __name__ == "__main__":  # as a file, from any folder: the checkout's packages, not this folder's modules
    folder = Path(__file__).resolve().parent
    sys.path[:] = [str(folder.parent), *(p for p in sys.path if Path(p or ".").resolve() != folder)]

try:
    import tyro
    from rich.console import Console
except ModuleNotFoundError as error:
    raise SystemExit(f"convert.py needs {error.name}, which serving alone does not: pip install '.[export]'") from None

from msdgs_serve.scene.errors import MsdgsError


def main(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    t: float | None = None,
    frames: int = 30,
    min_psnr: float | None = None,
) -> int:
    """Write a scene file as other viewers read it. What was written is read back, drawn and compared.

    The ending of OUT says the format:

    python export/convert.py ball.onnx ball.ply          one moment, as INRIA's trainer writes it

    python export/convert.py ball.onnx ball.spz          one moment, ten times smaller

    python export/convert.py ball.onnx ball.glb          one moment, as glTF with KHR_gaussian_splatting

    python export/convert.py ball.onnx ball.usdc         all of its time, as OpenUSD with a sample of poses a frame

    python export/convert.py ball.onnx frames/           a folder of numbered PLY files over the scene's time

    python export/convert.py ball.onnx ball.visionary.onnx     all of it, for Visionary in a browser

    Films are msdgs-render's: msdgs-render ball.onnx turn.mp4. docs/formats.md says what each format keeps.

    Args:
        scene: A scene file (.onnx).
        out: What to write: name.ply, name.spz, name.glb, name.usdc (or .usda, .usd), name.visionary.onnx, or a folder.
        t: The moment of a single file; by default the beginning of the scene's time.
        frames: How many files in a folder or frames of OpenUSD, evenly over the scene's time, both ends among them.
        min_psnr: What was written must be so close to the scene, dB, or nothing is; by default 45 for SPZ and Visionary
            and 60 for others, which lose nothing.
    """
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        with console.status("loading"):
            from export.exporters.command import Settings, convert  # heavy: not before --help
        convert(Settings(scene, out, t, frames, min_psnr), console)
    except KeyboardInterrupt:
        console.print("stopped; files that are there are whole", markup=False)
        return 130
    except (MsdgsError, OSError) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
