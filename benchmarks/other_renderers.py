"""One scene drawn by this project's rasterizer and by F3D, someone else's: how far the pictures differ, and the times.

python -m venv .venv-f3d && .venv-f3d/bin/pip install f3d==4.0.0
python benchmarks/other_renderers.py --f3d-python .venv-f3d/bin/python

F3D (https://f3d.app, 80 MB from PyPI, glibc 2.34 or newer) draws splats by OpenGL through EGL; without a GPU, Mesa's
software does (Debian, Ubuntu: `apt install libegl1 libgl1-mesa-dri`). It reads .splat files, so both get the numbers of
one: colours, opacities and rotations of 8 bits, no harmonics beyond the constant.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, rasterize
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.scene.spherical_harmonics import SH_C0

SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
"""A record of a .splat file; quaternions w x y z as 128 + 128 q."""

F3D_EPS2D = 0.3 / 4
"""Pixels²: F3D adds 0.3 / size² to a covariance in clip space, where the picture is 2 wide and not 1. It has neither
the cut at alpha 1/255 nor that at transmittance 1e-4, but ends a splat at 3 sigma."""


def main() -> None:
    """Draw, compare, print."""
    arguments = parse_arguments()
    records = read(arguments.splats) if arguments.splats else seeded(arguments.count, arguments.seed)
    camera = camera_for(records["means"], arguments)
    options = GSPLAT._replace(eps2d=F3D_EPS2D, alpha_min=arguments.alpha_min)
    ours, our_seconds = draw_ours(gaussians_of(records), camera, options, arguments.repeats)
    theirs, their_seconds, version = draw_f3d(records, camera, arguments)
    print(f"{len(records)} Gaussians, {camera.width}×{camera.height}")
    for name, seconds in (("msdgs", our_seconds), (f"F3D {version}", their_seconds)):
        print(f"{name:10} first frame {seconds[0] * 1e3:8.1f} ms, best of {len(seconds)} {min(seconds) * 1e3:8.1f} ms")
    difference = np.clip(ours, 0, 1) - theirs
    print(f"PSNR {-10 * np.log10(np.mean(difference**2)):.1f} dB, largest difference {np.abs(difference).max():.3f}")
    if arguments.out:
        write(arguments.out, np.concatenate([ours, theirs, np.abs(difference) * 20], axis=1))


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--f3d-python", default=sys.executable, help="an interpreter that can import f3d")
    parser.add_argument("--splats", type=Path, help="a .splat file or INRIA's .ply, instead of the seeded scene")
    parser.add_argument("--count", type=int, default=20_000, help="Gaussians of the seeded scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=400, help="width and height in pixels")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--eye", type=float, nargs=3, help="camera position; default: outside of the scene, along -z")
    parser.add_argument("--target", type=float, nargs=3, help="what it looks at; default: the median Gaussian")
    parser.add_argument("--up", type=float, nargs=3, default=(0.0, -1.0, 0.0))
    parser.add_argument("--alpha-min", type=float, default=GSPLAT.alpha_min, help="ours: where a splat ends")
    parser.add_argument("--out", type=Path, help="a picture: ours, theirs, 20 × the difference")
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


def to_bytes(quats: np.ndarray) -> np.ndarray:
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return np.clip(np.round(quats * 128 + 128), 0, 255).astype(np.uint8)


def read(path: Path) -> np.ndarray:
    """Records of a .splat file, or of a PLY as INRIA writes it: binary, all properties float32."""
    if path.suffix == ".splat":
        return np.fromfile(path, SPLAT)
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in header.decode().splitlines()]
    count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
    table = np.frombuffer(body, [(line[2], "<f4") for line in lines if line[:2] == ["property", "float"]], count)

    def columns(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], axis=1)

    records = np.zeros(count, SPLAT)
    records["means"] = columns("x", "y", "z")
    records["scales"] = np.exp(columns("scale_0", "scale_1", "scale_2"))
    colors = 0.5 + SH_C0 * columns("f_dc_0", "f_dc_1", "f_dc_2")
    opacities = 1 / (1 + np.exp(-columns("opacity")))
    records["rgba"] = np.clip(np.round(255 * np.hstack([colors, opacities])), 0, 255)
    records["quats"] = to_bytes(columns("rot_0", "rot_1", "rot_2", "rot_3"))
    return records


def gaussians_of(records: np.ndarray) -> Gaussians:
    """What a .splat file says, in float32."""
    quats = (records["quats"].astype(np.float32) - 128) / 128
    rgba = records["rgba"].astype(np.float32) / 255
    return Gaussians(
        means=np.ascontiguousarray(records["means"]),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.ascontiguousarray(records["scales"]),
        opacities=np.ascontiguousarray(rgba[:, 3]),
        sh=(rgba[:, None, :3] - 0.5) / np.float32(SH_C0),
    )


def camera_for(means: np.ndarray, arguments: argparse.Namespace) -> Camera:
    """As asked for, or so far away that nine in ten Gaussians are in a picture of 40°."""
    target = np.array(arguments.target) if arguments.target else np.median(means, axis=0).astype(float)
    radius = np.quantile(np.linalg.norm(means - target, axis=1), 0.9)
    eye = np.array(arguments.eye) if arguments.eye else target - [0, 0, 3 * radius]
    return Camera.from_look_at(eye, target, np.array(arguments.up), arguments.size, arguments.size, 40.0)


def draw_ours(
    gaussians: Gaussians, camera: Camera, options: RasterizerOptions, repeats: int
) -> tuple[np.ndarray, list[float]]:
    """The picture [H, W, 3] and the seconds of each repeat, the first with what compiling or loading takes."""
    seconds, rgb = [], np.empty(0)
    for _ in range(repeats):
        start = time.perf_counter()
        rgb = rasterize(gaussians, camera, options=options).rgb
        seconds.append(time.perf_counter() - start)
    return rgb, seconds


def draw_f3d(records: np.ndarray, camera: Camera, arguments: argparse.Namespace) -> tuple[np.ndarray, list[float], str]:
    """The picture [H, W, 3], the seconds of each repeat, and F3D's version."""
    pose = camera.camera_to_world
    with tempfile.TemporaryDirectory() as folder:
        file, image = Path(folder, "scene.splat"), Path(folder, "frame.png")
        records.tofile(file)
        job = {
            "file": str(file),
            "image": str(image),
            "size": [camera.width, camera.height],
            "position": pose[:3, 3].tolist(),
            "focal_point": (pose[:3, 3] + pose[:3, 2]).tolist(),
            "view_up": (-pose[:3, 1]).tolist(),
            "view_angle": float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
            "repeats": arguments.repeats,
        }
        command = [arguments.f3d_python, Path(__file__).with_name("draw_with_f3d.py"), json.dumps(job)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SystemExit(f"F3D did not draw:\n{done.stderr}")
        answer = json.loads(done.stdout.splitlines()[-1])
        picture = np.asarray(oiio.ImageBuf(str(image)).get_pixels(oiio.FLOAT))[..., :3]
    return picture, answer["seconds"], answer["version"]


def write(path: Path, picture: np.ndarray) -> None:
    buffer = oiio.ImageBuf(np.clip(picture, 0, 1).astype(np.float32))
    if not buffer.write(str(path), "uint8"):
        raise SystemExit(f"could not write {path}: {buffer.geterror()}")


if __name__ == "__main__":
    main()
