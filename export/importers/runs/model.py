"""Folders of other trainers' runs to a model.pt, which then goes the way of our own."""

import ast
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from export.importers.detect import read_splats
from export.importers.errors import ImportFailed
from export.importers.runs.deformgs import read_deformgs
from export.importers.runs.fidelity import frozen, unbent
from export.importers.runs.fourdgs import read_4dgs
from export.importers.scene import metadata_of
from export.importers.splats.base import Splats
from export.measure.rendered_error import posed
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, save_model

Reader = Callable[[Path, CanonicalGaussians, int, dict[str, Any]], tuple[DynamicGaussians, list[str]]]

RUNS: dict[str, Reader] = {"deformgs": read_deformgs, "4dgs": read_4dgs}
"""Reads the network of an iteration, given its canonical Gaussians and cfg_args: the model, and what to say of it."""

WHITE_BY_DEFAULT = {"deformgs": False, "4dgs": True}
"""Backgrounds, of runs without cfg_args."""

MOST_CAMERAS = 1_000
CHECKED_TIMES = 3
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


def write_model(run: Path, kind: str, output: Path, console: Console) -> list[dict[str, Any]]:
    """Write the last iteration of a run, of one of `RUNS`, as a model.pt; returns what a scene file of it has lost.

    Raises `ImportFailed` naming what is missing or differs.
    """
    clouds = {
        int(number[0]): p
        for p in run.glob("point_cloud/iteration_*/point_cloud.ply")
        if (number := re.findall(r"_([0-9]+)$", p.parent.name))
    }
    if not clouds:
        raise ImportFailed(run, "has no point_cloud/iteration_*/point_cloud.ply")
    iteration = max(clouds)
    source = read_splats(clouds[iteration], "ply")
    if source.dropped:
        raise ImportFailed(clouds[iteration], f"{source.dropped:,} Gaussians hold NaN, infinity or no direction")
    settings = _settings(run / "cfg_args")
    model, notes = RUNS[kind](run, canonical(source), iteration, settings)
    _check_poses(run, model)
    metadata = metadata_of(source.gaussians.means, source.gaussians.sh_degree, "0" * 64)
    cameras = _cameras(run / "cameras.json") or [camera.to_plain() for camera in metadata.cameras]
    info = SceneInfo(
        background=WHITE if settings.get("white_background", WHITE_BY_DEFAULT[kind]) else BLACK,
        bounds=[list(b) for b in metadata.bounds],
        cameras=cameras,
    )
    console.print(f"{run}: iteration {iteration:,}, {len(source):,} Gaussians", markup=False)
    lost = []
    if model.config.opacity_head or model.config.sh_head:
        with console.status("holding opacities and colors"), _usable(run):
            held = frozen(model, info)
        model, lost = held.model, [held.left_out()]
        notes.append(held.note())
    if kind == "deformgs":
        with console.status("comparing shapes"), _usable(run):
            shapes = unbent(model, info)
        lost.append(shapes.left_out())
        notes.append(shapes.note())
    save_model(output, model, info, iteration)
    for note in notes:
        console.print(note, markup=False)
    return lost


def _check_poses(run: Path, model: DynamicGaussians) -> None:
    """Raise `ImportFailed` where a network sends Gaussians to where none can be."""
    for t in np.linspace(0, 1, CHECKED_TIMES).tolist():
        with _usable(run, f" at t = {t:g}"):
            posed(model, t).validate()


@contextmanager
def _usable(run: Path, when: str = "") -> Iterator[None]:
    """Say of what can't be drawn that it comes from a run: finite weights may be wild ones, at some times only."""
    try:
        yield
    except InvalidInput as error:
        raise ImportFailed(run, f"its network gives Gaussians that can't be used{when}: {error}") from error


def canonical(source: Splats) -> CanonicalGaussians:
    """Activated Gaussians back in storage space, their quaternions as long as they were stored."""
    g = source.gaussians
    lengths = np.ones(len(g), np.float32) if source.quat_lengths is None else source.quat_lengths
    opacities = g.opacities.astype(np.float64).clip(1e-7, 1 - 1e-7)
    raw_opacities = np.log(opacities / (1 - opacities))
    arrays = (g.means, np.log(g.scales), g.quats * lengths[:, None], raw_opacities, g.sh[:, :1], g.sh[:, 1:])
    return CanonicalGaussians(*(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays))


def _settings(file: Path) -> dict[str, Any]:
    """The plain values of cfg_args, which is the text of a Namespace; nothing of it is run."""
    try:
        call = ast.parse(file.read_text(), mode="eval").body
    except FileNotFoundError:
        return {}
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ImportFailed(file, f"can't be read: {error}") from error
    values = {}
    for keyword in call.keywords if isinstance(call, ast.Call) else ():
        if isinstance(keyword.value, ast.Constant):
            values[keyword.arg] = keyword.value.value
    return values


def _cameras(file: Path) -> list[dict[str, Any]]:
    """Of INRIA's cameras.json, where there is one; position and rotation are camera to world in OpenCV axes."""
    if not file.is_file():
        return []
    try:
        cameras = []
        for stored in json.loads(file.read_text())[:MOST_CAMERAS]:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = stored["rotation"], stored["position"]
            size = int(stored["width"]), int(stored["height"])
            camera = Camera(stored["fx"], stored["fy"], size[0] / 2, size[1] / 2, *size, pose)
            intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
            name = re.sub(r"\s+", " ", str(stored["img_name"])) or "camera"
            cameras.append({"name": name, "t": 0.0, **intrinsics, "camera_to_world": pose.tolist()})
        return cameras
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, InvalidInput) as error:
        raise ImportFailed(file, f"isn't a list of cameras as INRIA's trainer writes it: {error!r}") from error
