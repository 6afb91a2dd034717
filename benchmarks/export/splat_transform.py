"""PLY and SPZ files of this project through PlayCanvas' splat-transform, and its PLY files read back here."""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from benchmarks.measuring import machine
from export.exporters.command import LOSSY, convert
from export.exporters.round_trip import RoundTrip, require
from export.importers.splats.formats import read_splats
from export.options import ConvertOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import MsdgsError

WRITTEN = (".ply", ".spz")
ROTATION = ["-r", "180,0,0"]
"""Version 3 doesn't convert the axes of an SPZ file to those of a PLY; version 2 did."""


def main(scene: Annotated[Path, tyro.conf.Positional], package: str = "@playcanvas/splat-transform@3.7.0") -> int:
    """Convert the first frame of a scene, let splat-transform write it as PLY, and print its PSNR against the scene.

    python -m benchmarks.export.splat_transform playbot.onnx

    Needs Node.js; npx downloads splat-transform. The exit status is 1 if a file is refused or comes back worse.

    Args:
        scene: A scene file.
        package: The package that npx runs.
    """
    console = Console(soft_wrap=True, highlight=False)
    console.print(machine(), markup=False)
    try:
        session = DeformationSession(scene)
        round_trip = RoundTrip(session)
        t0, _ = session.scene.metadata.time_range
        with tempfile.TemporaryDirectory() as folder:
            for suffix in WRITTEN:
                ours, theirs = Path(folder) / f"ours{suffix}", Path(folder) / f"theirs{suffix}.ply"
                convert(ConvertOptions(scene, ours, t0), Console(quiet=True))
                rotation = ROTATION if suffix == ".spz" else []
                subprocess.run(
                    ["npx", "--yes", package, "-w", ours, *rotation, theirs], check=True, capture_output=True
                )
                read = read_splats(theirs)
                psnr = round_trip.psnr(read.gaussians, t0)
                console.print(f"{suffix}: {len(read):,} Gaussians, {psnr:.1f} dB against the scene", markup=False)
                require(psnr, None, LOSSY, theirs.name)
    except subprocess.CalledProcessError as error:
        console.print(f"{package} refused: {error.stderr.decode(errors='replace').strip()}", markup=False)
        return 1
    except (MsdgsError, FileNotFoundError) as error:
        console.print(f"error: {error}", markup=False)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
