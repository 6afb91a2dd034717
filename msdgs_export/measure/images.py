"""Held-out images of a dataset, which frames of an export are compared with."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from msdgs_export.measure.frames import compare, render
from msdgs_export.measure.poses import Pose
from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.scene.camera import Camera
from msdgs_train.datasets import Frame, composite, load_scene
from msdgs_train.gaussians.model_file import SceneInfo

MAX_IMAGES = 24
"""Images compared with; of more, evenly spread ones."""


class HeldOutImages:
    """Held-out images over the scene's background, and the cameras of those that were trained on."""

    def __init__(self, folder: Path, info: SceneInfo, begin: Callable[[int], Callable[[], object]]) -> None:
        """Raises `DatasetInvalid` or `InvalidInput` if the folder holds no dataset."""
        data = load_scene(folder, info.size, info.llffhold, info.time_from, info.masks).in_frame(info.placement)
        t0, t1 = info.time_range
        self.training: list[Camera] = [frame.camera for frame in data.splits["train"]]
        held_out = [frame for frame in data.splits["test"] or data.splits["val"] if t0 <= frame.t <= t1]
        chosen = np.linspace(0, len(held_out) - 1, min(MAX_IMAGES, len(held_out))).round().astype(int)
        self._frames: list[tuple[Frame, np.ndarray, np.ndarray | None]] = []
        self._background = info.background
        on_image = begin(len(chosen))
        for i in chosen:
            frame = held_out[i]
            self._frames.append((frame, composite(frame.load_rgba(), info.background), frame.load_mask()))
            on_image()

    def psnr(self, pose: Pose, options: RasterizerOptions) -> float | None:
        """Mean PSNR in dB over the images, of the pixels that count, as papers report it; None if there are none."""
        values = []
        for frame, target, mask in self._frames:
            shown = slice(None) if mask is None else mask
            rgb = render(pose(frame.t), frame.camera, self._background, options)
            values.append(compare(rgb[shown], target[shown]).psnr)
        return float(np.mean(values)) if values else None
