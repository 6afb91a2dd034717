"""Scene files side by side in one picture: `python benchmarks/contact_sheet.py scenes/*.onnx -o sheet.png`.

Each is drawn from the first of its cameras, at the beginning of its time and, where it moves, in the middle too.
"""

import argparse
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer

COLUMNS = 4
INCHES = 2.6


def main() -> None:
    """Draw and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", type=int, default=400, help="pixels of each picture")
    options = parser.parse_args()
    pictures = [each for scene in options.scenes for each in drawn(scene, options.size)]
    rows = -(-len(pictures) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(INCHES * COLUMNS, (INCHES + 0.3) * rows), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, pixels) in zip(axes.flat, pictures, strict=False):
        axis.imshow(pixels)
        axis.set_title(title, fontsize=7)
    figure.tight_layout(pad=0.3)
    figure.savefig(options.output, dpi=110)


def drawn(scene: Path, size: int) -> list[tuple[str, np.ndarray]]:
    """Titles and [H, W, 3] pictures."""
    session, renderer = DeformationSession(scene), Renderer()
    view = session.scene.metadata.cameras[0]
    t0, t1 = session.scene.metadata.time_range
    times = [t0, (t0 + t1) / 2] if session.scene.moving_count else [t0]
    camera = view.camera.resized(size, round(size * view.camera.height / view.camera.width))
    return [(f"{scene.stem}, t = {t:g}", renderer.render(session, camera, t).display_pixels()) for t in times]


if __name__ == "__main__":
    main()
