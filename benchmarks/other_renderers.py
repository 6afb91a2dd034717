"""One scene drawn by this project's rasterizer and by others: how far the images differ, and the times, in turns.

python -m venv .venv-f3d && .venv-f3d/bin/pip install f3d==4.0.0
python benchmarks/other_renderers.py --f3d-python .venv-f3d/bin/python

F3D (https://f3d.app, 80 MB from PyPI, glibc 2.34 or newer) draws splats by OpenGL through EGL; without a GPU, Mesa's
software does (Debian, Ubuntu: `apt install libegl1 libgl1-mesa-dri`). Open3D (https://www.open3d.org, 400 MB from PyPI,
from version 0.20, `--open3d-python`) does by Vulkan (`apt install mesa-vulkan-drivers libusb-1.0-0`). Both read .splat
files, so all get the numbers of one: colors, opacities and rotations of 8 bits, no harmonics beyond the constant.
"""

import argparse
import contextlib
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.drawers import AS_DRAWN_BY, Drawer, psnr
from benchmarks.splat_files import SPLAT, gaussians_of, read_records, to_bytes
from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.scene import Camera


def main() -> None:
    """Draw, compare, print."""
    arguments = parse_arguments()
    records = read_records(arguments.splats) if arguments.splats else seeded(arguments.count, arguments.seed)
    camera, gaussians = camera_for(records["means"], arguments), gaussians_of(records)
    pythons = {"F3D": arguments.f3d_python, "Open3D": arguments.open3d_python}
    with contextlib.ExitStack() as stack:
        file = Path(stack.enter_context(tempfile.TemporaryDirectory()), "scene.splat")
        records.tofile(file)
        drawers = [stack.enter_context(Drawer(name, p, file, camera)) for name, p in pythons.items() if p]
        if not drawers:
            raise SystemExit("nothing to compare with: give --f3d-python, --open3d-python or both")
        seconds: dict[str, list[float]] = {name: [] for name in ("msdgs", *(drawer.name for drawer in drawers))}
        for _ in range(arguments.repeats):
            start = time.perf_counter()
            rasterize(gaussians, camera)
            seconds["msdgs"].append(time.perf_counter() - start)
            for drawer in drawers:
                seconds[drawer.name].append(drawer.draw())
        versions = {drawer.name: drawer.version for drawer in drawers}
        images = {drawer.name: drawer.image() for drawer in drawers}
    print(f"{len(records)} Gaussians, {camera.width}×{camera.height}")
    for name, taken in seconds.items():
        title = f"{name} {versions.get(name, '')}"
        print(f"{title:14} first frame {taken[0] * 1e3:8.1f} ms, best of {len(taken)} {min(taken) * 1e3:8.1f} ms")
    panels = []
    for name, theirs in images.items():
        options = AS_DRAWN_BY[name]._replace(alpha_min=arguments.alpha_min)
        ours = np.clip(rasterize(gaussians, camera, options=options).rgb, 0, 1)
        difference = np.abs(ours - theirs)
        print(f"{name}: PSNR {psnr(ours, theirs):.1f} dB, largest difference {difference.max():.3f}")
        panels.append(np.concatenate([ours, theirs, difference * 20], axis=1))
    if arguments.out:
        write(arguments.out, np.concatenate(panels))


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--f3d-python", help="an interpreter that can import f3d")
    parser.add_argument("--open3d-python", help="an interpreter that can import open3d")
    parser.add_argument("--splats", type=Path, help="a .splat file or INRIA's .ply, instead of the seeded scene")
    parser.add_argument("--count", type=int, default=20_000, help="Gaussians of the seeded scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=400, help="width and height in pixels")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--eye", type=float, nargs=3, help="camera position; default: outside of the scene, along -z")
    parser.add_argument("--target", type=float, nargs=3, help="what it looks at; default: the median Gaussian")
    parser.add_argument("--up", type=float, nargs=3, default=(0.0, -1.0, 0.0))
    parser.add_argument("--alpha-min", type=float, default=GSPLAT.alpha_min, help="ours: where a splat ends")
    parser.add_argument("--out", type=Path, help="an image: ours, theirs, 20 × the difference; a row a renderer")
    return parser.parse_args()


def seeded(count: int, seed: int) -> np.ndarray:
    """Records of an object of size 1: a bumpy shell of flat splats, most opaque, and a tenth floating about it."""
    rng = np.random.default_rng(seed)
    records = np.zeros(count, SPLAT)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = 1 + 0.15 * np.sin(5 * directions).sum(axis=1)
    radii[: count // 10] = rng.uniform(0, 1.6, count // 10)
    records["means"] = directions * radii[:, None]
    records["scales"] = np.exp(rng.normal(np.log(1.5 / np.sqrt(count)), 0.6, (count, 3))) * [1, 1, 0.2]
    records["rgba"][:, :3] = np.clip(
        128 + 100 * np.sin(4 * directions + [0, 1, 2]) + rng.normal(0, 20, (count, 3)), 0, 255
    )
    records["rgba"][:, 3] = np.where(rng.random(count) < 0.7, rng.uniform(180, 255, count), rng.uniform(5, 120, count))
    records["quats"] = to_bytes(rng.normal(size=(count, 4)))
    return records


def camera_for(means: np.ndarray, arguments: argparse.Namespace) -> Camera:
    """As asked for, or so far away that nine in ten Gaussians are in an image of 40°."""
    target = np.array(arguments.target) if arguments.target else np.median(means, axis=0).astype(float)
    radius = np.quantile(np.linalg.norm(means - target, axis=1), 0.9)
    eye = np.array(arguments.eye) if arguments.eye else target - [0, 0, 3 * radius]
    return Camera.from_look_at(eye, target, np.array(arguments.up), arguments.size, arguments.size, 40.0)


def write(path: Path, image: np.ndarray) -> None:
    buffer = oiio.ImageBuf(np.clip(image, 0, 1).astype(np.float32))
    if not buffer.write(str(path), "uint8"):
        raise SystemExit(f"could not write {path}: {buffer.geterror()}")


if __name__ == "__main__":
    main()
