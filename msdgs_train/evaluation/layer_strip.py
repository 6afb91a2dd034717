"""The Gaussians after k = 0, 1, …, K layers of the deformation, side by side, as in figure 1b of the paper."""

from pathlib import Path
from typing import Any

import numpy as np

from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.evaluation.sheets import Panel, check_sheet, draw_sheet
from msdgs_train.gaussians.model_file import LoadedModel, load_model

DEFAULT_TIME = 0.3  # fraction of the scene's time; in the middle, where the time window starts, deformations are small


def write_steps(
    path: Path, out: Path, *, t: float | None = None, size: int = 400, camera: str | None = None
) -> list[np.ndarray]:
    """Draw the model in `path` at time `t` after each of its layers into the PNG `out`; returns the K + 1 images.

    The arguments are the options of `msdgs-train steps`. Atomic; the folder of `out` is created if missing.

    Raises `CheckpointInvalid` if the model can't be read, `InvalidInput` naming an argument that is out of range.
    """
    check_sheet("out", out)
    loaded = load_model(path)
    first, last = loaded.scene.time_range
    t = first + DEFAULT_TIME * (last - first) if t is None else t
    if not first <= t <= last:
        raise InvalidInput("t", f"in the scene's time range, [{first:g}, {last:g}]", t)
    entry = _stored_camera(loaded, t, camera)
    images = render_steps(loaded, t, camera_of(entry, size))
    captions = ["k = 0, canonical", *(f"k = {k}" for k in range(1, len(images)))]
    panels = [Panel(pixels, caption) for pixels, caption in zip(images, captions, strict=True)]
    draw_sheet(out, f"t = {t:g}, camera {entry['name']}, step {loaded.step:,}", [panels])
    return images


def render_steps(loaded: LoadedModel, t: float, camera: Camera) -> list[np.ndarray]:
    """Render K + 1 images, [H, W, 3] uint8: after no layer, after the first, …, after all."""
    return [to_bytes(loaded.render(camera, t, k).numpy()) for k in range(len(loaded.model.deformation) + 1)]


def _stored_camera(loaded: LoadedModel, t: float, name: str | None) -> dict[str, Any]:
    cameras = {entry["name"]: entry for entry in loaded.scene.cameras}
    if not cameras:
        raise InvalidInput("model", "one that holds a camera; training stores those of its images", "none")
    if name is None:
        return min(cameras.values(), key=lambda entry: abs(entry["t"] - t))
    if name not in cameras:
        raise InvalidInput("camera", f"one of {', '.join(cameras)}", name)
    return cameras[name]


def camera_of(entry: dict[str, Any], width: int) -> Camera:
    """Return a camera from a model file, for images `width` pixels wide."""
    if width < 1:
        raise InvalidInput("size", "a width of 1 pixel or more", width)
    values = {name: entry[name] for name in ("fx", "fy", "cx", "cy", "width", "height")}
    camera = Camera(**values, camera_to_world=np.array(entry["camera_to_world"]))
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))
