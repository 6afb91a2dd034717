"""Files of other programs, imported, served and drawn through POST /render, side by side in one image:

python benchmarks/imported_formats.py data/splats data/splat_sequence_monkey -o docs/images/formats.png

Arguments are files and folders; a folder that is no scene itself gives everything in it that is recognised.
"""

import argparse
import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import httpx
import matplotlib.pyplot as plt
import numpy as np

from export.importers import ImportFailed, recognise
from export.to_onnx import main as to_onnx
from msdgs_serve.deformation import DeformationSession
from tests.support.service import serving

COLUMNS = 4
INCHES = 2.6
BEHIND = 0.1
CAMERA = {"type": "orbit", "azimuth": -25, "elevation": 15}
ALONG = (0.0, 0.5)
"""Parts of a scene's time that are shown where it moves."""


def main() -> int:
    """Import, ask, write the sheet and print a line for each; 1 where a file can't be imported or nothing is seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", type=int, default=400, help="pixels of each image")
    options = parser.parse_args()
    images, failed = [], []
    with tempfile.TemporaryDirectory() as folder:
        sources = {}
        for i, (source, kind) in enumerate(each for path in options.inputs for each in recognised(path)):
            scene = Path(folder) / f"scene{i}.onnx"
            if to_onnx(source, scene):
                failed.append(str(source))
            else:
                sources[scene] = f"{source.parent.name}/{source.name}", kind
        with serving(*sources) as client:
            for scene, (name, kind) in sources.items():
                for t, pixels in rendered(client, scene, options.size):
                    seen = float((pixels[..., 3] > 0.5).mean())
                    count = len(DeformationSession(scene).scene)
                    print(f"{name}  {kind}  t = {t:g}  {count:,} Gaussians, fill {seen:.0%} of the image")
                    images.append((f"{name}, {kind}" + (f", t = {t:g}" if t else ""), pixels))
                    failed += [] if 0.01 < seen < 0.99 else [name]
    write(options.output, images)
    print(f"{len(images)} images; failed: {', '.join(failed) or 'none'}")
    return bool(failed)


def recognised(path: Path) -> Iterator[tuple[Path, str]]:
    """Inputs and what they are."""
    try:
        yield path, recognise(path)
    except ImportFailed as error:
        if not path.is_dir():
            print(error)
            return
        for each in sorted(path.iterdir()):
            yield from recognised(each)


def rendered(client: httpx.Client, scene: Path, size: int) -> Iterator[tuple[float, np.ndarray]]:
    """Times and [H, W, 4] images, as the service sends them."""
    session = DeformationSession(scene)
    t0, t1 = session.scene.metadata.time_range
    for part in ALONG if session.scene.moving_count else ALONG[:1]:
        t = t0 + part * (t1 - t0)
        request = {"scene": scene.stem, "t": t, "camera": CAMERA, "width": size, "height": size}
        answer = client.post("/render", json=request | {"format": "png", "background": "transparent"})
        if answer.status_code != httpx.codes.OK:
            raise SystemExit(f"{scene.stem}: {answer.status_code} {answer.text}")
        yield t, plt.imread(io.BytesIO(answer.content))


def write(output: Path, images: list[tuple[str, np.ndarray]]) -> None:
    """The sheet."""
    rows = -(-len(images) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(INCHES * COLUMNS, (INCHES + 0.3) * rows), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, pixels) in zip(axes.flat, images, strict=False):
        axis.imshow(pixels[..., :3] * pixels[..., 3:] + BEHIND * (1 - pixels[..., 3:]))
        axis.set_title(title, fontsize=6)
    figure.tight_layout(pad=0.3)
    figure.savefig(output, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
