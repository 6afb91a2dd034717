"""Renderers in processes of their own, told over a pipe to draw one frame, so that several can take turns."""

import contextlib
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene import Camera

FOLDER = Path(__file__).resolve().parent
SCRIPTS = {"F3D": FOLDER / "draw_with_f3d.py", "Open3D": FOLDER / "draw_with_open3d.py"}

AS_DRAWN_BY: dict[str, RasterizerOptions] = {
    # F3D adds 0.3 / size² to a covariance in clip space, where the image is 2 wide and not 1. It has neither the cut
    # at alpha 1/255 nor that at transmittance 1e-4, but ends a splat at 3 sigma.
    "F3D": GSPLAT._replace(eps2d=0.3 / 4),
    "Open3D": GSPLAT,
}
"""Our options that come nearest to another renderer's constants."""


class Drawer:
    """Draws one view of one file, at each call of `draw`; a context, which ends the process.

    A script gets JSON as its only argument: file, image, size [2], position [3], focal_point [3], view_up [3],
    view_angle (vertical, in degrees). For each line that it reads it draws a frame and prints {"seconds": …}; `save`
    has it write the frame to `image`; before the first line it prints {"version": …}.
    """

    def __init__(self, name: str, python: Path | str, file: Path, camera: Camera, checkout: Path | None = None) -> None:
        """`name` is a key of `SCRIPTS`, or anything where a checkout of this project is to draw a .npz of Gaussians."""
        self.name = name
        self._folder = tempfile.TemporaryDirectory()
        self._image = Path(self._folder.name, "frame.npy" if checkout else "frame.png")
        script = FOLDER / "draw_with_checkout.py" if checkout else SCRIPTS[name]
        environment = {**os.environ, "PYTHONPATH": str(checkout)} if checkout else None
        pose = camera.camera_to_world
        job = {
            "file": str(file),
            "image": str(self._image),
            "size": [camera.width, camera.height],
            "position": pose[:3, 3].tolist(),
            "focal_point": (pose[:3, 3] + pose[:3, 2]).tolist(),
            "view_up": (-pose[:3, 1]).tolist(),
            "view_angle": float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
        }
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self._process = subprocess.Popen(
            [str(python), str(script), json.dumps(job)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        self.version = str(self._answer("version"))

    def __enter__(self) -> "Drawer":
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()
        self._folder.cleanup()

    def draw(self) -> float:
        """Seconds that a frame took."""
        return float(self._ask("draw", "seconds"))

    def image(self) -> np.ndarray:
        """[H, W, 3] of the last frame."""
        self._ask("save", "saved")
        if self._image.suffix == ".npy":
            return np.load(self._image)
        return np.asarray(oiio.ImageBuf(str(self._image)).get_pixels(oiio.FLOAT))[..., :3]

    def _ask(self, order: str, key: str) -> Any:
        assert self._process.stdin
        with contextlib.suppress(BrokenPipeError):  # what it died of is in its answer
            print(order, file=self._process.stdin, flush=True)
        return self._answer(key)

    def _answer(self, key: str) -> Any:
        assert self._process.stdout
        for line in self._process.stdout:
            if line.startswith(f'{{"{key}"'):  # the libraries print too
                return json.loads(line)[key]
        self._errors.seek(0)
        raise SystemExit(f"{self.name} did not draw:\n{self._errors.read()[-3000:]}")


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    """dB of two images in [0, 1], infinite where they are the same."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - np.clip(other, 0, 1)) ** 2))
    return -10 * np.log10(error) if error else float("inf")
