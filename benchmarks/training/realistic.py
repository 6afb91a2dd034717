"""Clips of the synthetic scene with the faults of a hand-held camera: exposure that drifts, poses that are off, motion
blur. Each is a dataset of its own, in D-NeRF's layout.

Every 8th frame is for testing, and those halfway between for validation. They have no fault: what counts is how near a
model comes to the scene itself.
"""

import json
import math
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV, orbit
from msdgs_train.datasets.common.images import write_png
from msdgs_train.datasets.synthetic.generate import CAMERA_ANGLE_X, CAMERA_DISTANCE
from msdgs_train.datasets.synthetic.rendering import render

TURN, ELEVATION, SWAY = 200.0, 28.0, 12.0  # degrees: way around the scene; mean elevation, and its amplitude
UP = np.array([0.0, 0.0, 1.0])
GAIN, WARMTH = 0.15, 0.05  # amplitudes, in linear light: of all channels; of red, and of blue the other way
ERROR_PX = 0.5  # at most: by yaw and pitch at the center of the image, by roll at its border
SHUTTER, MOMENTS = 0.5, 8  # exposed fraction of the time between frames; renderings of that time
GAMMA = 2.2

Shot = Callable[[float], tuple[np.ndarray, Camera]]
"""The image of a time in [0, 1], [H, W, 4] uint8, and the camera that the dataset states."""


@dataclass(frozen=True)
class Options:
    """Make the datasets OUT/clip_exposure, OUT/clip_poses and OUT/clip_blur.

    python -m benchmarks.training.realistic data
    """

    out: Annotated[Path, tyro.conf.Positional] = Path("data")
    size: int = 112
    """Width and height of the images in pixels."""
    frames: int = 96
    seed: int = 0
    check: bool = False
    """Test this benchmark at a small size."""


def main(options: Options) -> int:
    """Write the datasets."""
    if options.check:
        with tempfile.TemporaryDirectory() as out:
            return main(replace(options, check=False, out=Path(out), size=16, frames=9))
    recording = Recording(options)
    for shot in (recording.exposure, recording.poses, recording.blur):
        write(options.out / f"clip_{shot.__name__}", np.linspace(0, 1, options.frames), shot, recording.clip)
    return 0


class Recording:
    """The camera's way around the scene, and its faults."""

    def __init__(self, options: Options) -> None:
        rng = np.random.default_rng(options.seed)
        self.size, self.frames = options.size, options.frames
        self.phases, self.errors = rng.uniform(0, 2 * math.pi, 2), rng.uniform(-1, 1, (options.frames, 3))

    def camera(self, t: float) -> Camera:
        """The true one."""
        pose = orbit(np.zeros(3), CAMERA_DISTANCE, TURN * t, ELEVATION + SWAY * math.sin(6 * math.pi * t), UP)
        return Camera.from_fov(pose, self.size, self.size, math.degrees(CAMERA_ANGLE_X))

    def clip(self, t: float) -> tuple[np.ndarray, Camera]:
        """Without faults."""
        return render(self.camera(t), t), self.camera(t)

    def exposure(self, t: float) -> tuple[np.ndarray, Camera]:
        """With another gain and color temperature."""
        gain = 1 + GAIN * math.sin(4 * math.pi * t + self.phases[0])
        warmth = WARMTH * math.sin(6 * math.pi * t + self.phases[1])
        rgba, camera = self.clip(t)
        linear = (rgba[..., :3] / 255) ** GAMMA * gain * np.array([1 + warmth, 1, 1 - warmth])
        rgba[..., :3] = np.rint(255 * np.clip(linear, 0, 1) ** (1 / GAMMA))
        return rgba, camera

    def poses(self, t: float) -> tuple[np.ndarray, Camera]:
        """With a rotation of the stated camera."""
        rgba, camera = self.clip(t)
        yaw, pitch, roll = self.errors[round(t * (self.frames - 1))]
        error = np.eye(4)
        angles = ERROR_PX * np.array([pitch / camera.fx, yaw / camera.fx, roll / (self.size / 2)])
        error[:3, :3] = Rotation.from_rotvec(angles).as_matrix()
        return rgba, replace(camera, camera_to_world=camera.camera_to_world @ error)

    def blur(self, t: float) -> tuple[np.ndarray, Camera]:
        """The mean of several moments, in linear light."""
        moments = t + SHUTTER / (self.frames - 1) * ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5)
        shots = np.stack([self.clip(moment)[0] for moment in moments.clip(0, 1)]) / 255
        alpha, coverage = shots[..., 3:], shots[..., 3:].mean(axis=0)
        rgb = (shots[..., :3] ** GAMMA * alpha).mean(axis=0) / np.where(coverage > 0, coverage, 1)
        rgba = np.concatenate([rgb ** (1 / GAMMA), coverage], axis=2)
        return np.rint(255 * rgba).astype(np.uint8), self.camera(t)


def write(folder: Path, times: np.ndarray, training: Shot, held_out: Shot) -> None:
    """Write a dataset."""
    splits: dict[str, list[dict[str, object]]] = {"train": [], "val": [], "test": []}
    for index, t in enumerate(map(float, times)):
        split = {0: "test", 4: "val"}.get(index % 8, "train")
        rgba, camera = (training if split == "train" else held_out)(t)
        (folder / split).mkdir(parents=True, exist_ok=True)
        write_png(folder / split / f"r_{index:03d}.png", rgba)
        pose = camera.camera_to_world @ OPENGL_TO_OPENCV
        splits[split].append({"file_path": f"./{split}/r_{index:03d}", "time": t, "transform_matrix": pose.tolist()})
    for split, frames in splits.items():
        text = json.dumps({"camera_angle_x": CAMERA_ANGLE_X, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
