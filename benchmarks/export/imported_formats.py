"""Files of other programs, imported, served and rendered through `POST /render`, as one image."""

import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import tyro

from benchmarks.measuring import machine
from benchmarks.rasterizer.scenes import object_scene
from benchmarks.service.process import Running, service
from msdgs_export.cli.to_onnx import main as to_onnx
from msdgs_export.exporters.ply import write_ply
from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.options import ExportOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_train.evaluation.sheets import Panel, draw_sheet
from tests.support.splat_files import splat_bytes

COLUMNS = 4
BACKGROUND = 0.1
CAMERA = {"type": "orbit", "azimuth": -25, "elevation": 15}
TIMES = (0.0, 0.5)
"""Fractions of the time range at which a moving scene is shown."""


def main(
    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/formats.png"),
    size: int = 400,
    check: bool = False,
) -> int:
    """Import files, request a frame of each from the service, and draw them into one image.

    python -m benchmarks.export.imported_formats data/splats data/splat_sequence_monkey -o docs/images/formats.png

    The exit status is 1 if a file can't be imported or its frame is empty.

    Args:
        inputs: Files and folders; of a folder that is no scene itself, everything that is recognized.
        output: The image to write.
        size: Width and height of each frame in pixels.
        check: Test this benchmark on two small files.
    """
    if check:
        return self_test()
    if not inputs:
        raise SystemExit("name files or folders to import")
    print(machine())
    images, failed, sources = [], [], {}
    with tempfile.TemporaryDirectory() as folder:
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
                    print(f"{name}  {kind}  t = {t:g}  {count:,} Gaussians cover {seen:.0%} of the image")
                    rgb = pixels[..., :3] * pixels[..., 3:] + BACKGROUND * (1 - pixels[..., 3:])
                    images.append(Panel((255 * rgb).round().astype(np.uint8), f"{name}, t = {t:g}"))
                    failed += [] if 0.01 < seen < 0.99 else [name]
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_sheet(output, "Imported files", [images[i : i + COLUMNS] for i in range(0, len(images), COLUMNS)])
    print(f"{len(images)} images; failed: {', '.join(failed) or 'none'}")
    return int(bool(failed))


def detected(path: Path) -> Iterator[tuple[Path, str]]:
    """Inputs and their formats."""
    try:
        yield path, detect_format(path)
    except ImportFailed as error:
        if not path.is_dir():
            print(error)
            return
        for each in sorted(path.iterdir()):
            yield from detected(each)


def rendered(running: Running, scene: Path, size: int) -> Iterator[tuple[float, np.ndarray]]:
    """Times and [H, W, 4] images from the service."""
    session = DeformationSession(scene)
    t0, t1 = session.scene.metadata.time_range
    for part in TIMES if session.scene.moving_count else TIMES[:1]:
        t = t0 + part * (t1 - t0)
        request = {"scene": scene.stem, "t": t, "camera": CAMERA, "width": size, "height": size}
        answer = running.ask("POST", "/render", request | {"format": "png", "background": "transparent"})
        if answer.status != 200:
            raise SystemExit(f"{scene.stem}: {answer.status} {answer.body[:200]!r}")
        yield t, plt.imread(io.BytesIO(answer.body))


def self_test() -> int:
    """Import seeded splats as PLY and .splat."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        gaussians = object_scene(3000)
        write_ply(folder / "some.ply", gaussians)
        (folder / "some.splat").write_bytes(splat_bytes(gaussians))
        return main((folder / "some.ply", folder / "some.splat"), folder / "sheet.png", 64)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
