"""Files of other programs, imported, served and drawn through POST /render, side by side in one image:

python -m benchmarks.export.imported_formats data/splats data/splat_sequence_monkey -o docs/images/formats.png

Arguments are files and folders; a folder that is no scene itself gives everything in it that is recognised. Ends with 1
if one of them can't be imported or nothing is seen of it.
"""

import argparse
import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.measuring import machine
from benchmarks.rasterizer.scenes import object_scene, write_splat
from benchmarks.service.process import Running, service
from export.exporters.ply import write_ply
from export.importers.detect import detect_format
from export.importers.errors import ImportFailed
from export.options import ExportOptions
from export.to_onnx import main as to_onnx
from msdgs_serve.deformation import DeformationSession
from msdgs_train.evaluation.sheets import Panel, draw_sheet

COLUMNS = 4
BEHIND = 0.1
CAMERA = {"type": "orbit", "azimuth": -25, "elevation": 15}
ALONG = (0.0, 0.5)
"""Parts of a scene's time that are shown where it moves."""


def main() -> int:
    """Import, ask, write the sheet and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="*", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/formats.png"))
    parser.add_argument("--size", type=int, default=400, help="pixels of each image")
    parser.add_argument("--check", action="store_true", help="only see that this works, on two small files")
    options = parser.parse_args()
    if options.check:
        return check()
    if not options.inputs:
        parser.error("name files or folders to import")
    return draw(options.inputs, options.output, options.size)


def draw(inputs: list[Path], output: Path, size: int) -> int:
    """1 if a file can't be imported or nothing is seen of it."""
    print(machine())
    images, failed = [], []
    with tempfile.TemporaryDirectory() as folder:
        sources = {}
        for i, (source, kind) in enumerate(each for path in inputs for each in detected(path)):
            scene = Path(folder) / f"scene{i}.onnx"
            if to_onnx(ExportOptions(source, scene)):
                failed.append(str(source))
            else:
                sources[scene] = f"{source.parent.name}/{source.name}", kind
        with service(*sources) as running:
            for scene, (name, kind) in sources.items():
                for t, pixels in rendered(running, scene, size):
                    seen = float((pixels[..., 3] > 0.5).mean())
                    count = len(DeformationSession(scene).scene)
                    print(f"{name}  {kind}  t = {t:g}  {count:,} Gaussians, fill {seen:.0%} of the image")
                    rgb = pixels[..., :3] * pixels[..., 3:] + BEHIND * (1 - pixels[..., 3:])
                    images.append(Panel((255 * rgb).round().astype(np.uint8), f"{name}, t = {t:g}"))
                    failed += [] if 0.01 < seen < 0.99 else [name]
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_sheet(output, "Imported files", [images[i : i + COLUMNS] for i in range(0, len(images), COLUMNS)])
    print(f"{len(images)} images; failed: {', '.join(failed) or 'none'}")
    return bool(failed)


def detected(path: Path) -> Iterator[tuple[Path, str]]:
    """Inputs and what they are."""
    try:
        yield path, detect_format(path)
    except ImportFailed as error:
        if not path.is_dir():
            print(error)
            return
        for each in sorted(path.iterdir()):
            yield from detected(each)


def rendered(running: Running, scene: Path, size: int) -> Iterator[tuple[float, np.ndarray]]:
    """Times and [H, W, 4] images, as the service sends them."""
    session = DeformationSession(scene)
    t0, t1 = session.scene.metadata.time_range
    for part in ALONG if session.scene.moving_count else ALONG[:1]:
        t = t0 + part * (t1 - t0)
        request = {"scene": scene.stem, "t": t, "camera": CAMERA, "width": size, "height": size}
        answer = running.ask("POST", "/render", request | {"format": "png", "background": "transparent"})
        if answer.status != 200:
            raise SystemExit(f"{scene.stem}: {answer.status} {answer.body[:200]!r}")
        yield t, plt.imread(io.BytesIO(answer.body))


def check() -> int:
    """Seeded splats as PLY and .splat."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        gaussians = object_scene(3000)
        write_ply(folder / "some.ply", gaussians)
        write_splat(folder / "some.splat", gaussians)
        return draw([folder / "some.ply", folder / "some.splat"], folder / "sheet.png", 64)


if __name__ == "__main__":
    sys.exit(main())
