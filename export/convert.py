"""`python export/convert.py scene.onnx OUT`: conversion of a scene file to formats of other viewers."""

import sys
from pathlib import Path
from typing import Annotated

if __name__ == "__main__":  # as a file, from any folder: the checkout's packages, not this folder's modules
    folder = Path(__file__).resolve().parent
    sys.path[:] = [str(folder.parent), *(p for p in sys.path if Path(p or ".").resolve() != folder)]

from export.command_line import Console, run, tyro


def main(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    t: float | None = None,
    frames: int = 30,
    min_psnr: float | None = None,
) -> int:
    """Convert a scene file for other viewers. The written file is read back, rendered and compared with the scene.

    The suffix of OUT selects the format:

    python export/convert.py ball.onnx ball.ply          one time, as INRIA's trainer writes it

    python export/convert.py ball.onnx ball.spz          one time, ten times smaller

    python export/convert.py ball.onnx ball.glb          one time, as glTF with KHR_gaussian_splatting

    python export/convert.py ball.onnx ball.usdc         the whole time range, as OpenUSD with a time sample per frame

    python export/convert.py ball.onnx frames/           a folder of numbered PLY files over the scene's time

    python export/convert.py ball.onnx ball.visionary.onnx     the whole scene, for Visionary in a browser

    For videos use msdgs-render: msdgs-render ball.onnx turn.mp4. docs/formats.md lists what each format keeps.

    Args:
        scene: A scene file (.onnx).
        out: What to write: name.ply, name.spz, name.glb, name.usdc (or .usda, .usd), name.visionary.onnx, or a folder.
        t: The time of a single file; by default the start of the scene's time range.
        frames: The number of files in a folder or frames of OpenUSD, evenly over the time range, both ends among them.
        min_psnr: PSNR of the written file against the scene, dB, below which it isn't kept; by default 45 for SPZ and
            Visionary and 60 for others, which are lossless.
    """

    def converted(console: Console) -> None:
        with console.status("loading"):
            from export.exporters.command import Settings, convert  # slow to import: not before --help
        convert(Settings(scene, out, t, frames, min_psnr), console)

    return run(converted, "stopped; existing files are complete")


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
