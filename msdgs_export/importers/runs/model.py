"""Run folders of other trainers to a model.pt, which is then exported as any other."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.base import RunImporter
from msdgs_export.importers.runs.deformgs import DeformGSImporter
from msdgs_export.importers.runs.fourdgs import FourDGSImporter
from msdgs_export.importers.runs.grid4d import Grid4DImporter
from msdgs_export.importers.runs.scgs import SCGSImporter
from msdgs_export.importers.runs.state import RunFolder, stores
from msdgs_export.importers.scene import metadata_of
from msdgs_export.importers.splats.base import UNUSABLE, Splats, as_float32, logit
from msdgs_export.importers.splats.formats import read_splats, refuse_pointer
from msdgs_export.measure.poses import posed
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.metadata import SceneCamera
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model_file import SceneInfo, save_model

RUNS: dict[str, RunImporter] = {
    "scgs": SCGSImporter(),
    "grid4d": Grid4DImporter(),
    "deformgs": DeformGSImporter(),
    "4dgs": FourDGSImporter(),
}
"""Importers by name of the format; those with a marker come before others with the same path."""

MAX_CAMERAS = 1_000
CHECKED_TIMES = 3
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


def run_format(folder: Path) -> str | None:
    """The format of a run folder, one of `RUNS`; None for other folders."""
    found = (
        name for name, importer in RUNS.items() if any(_is_of(importer, f) for f in folder.glob(importer.networks))
    )
    return next(found, None)


def _is_of(importer: RunImporter, networks: Path) -> bool:
    return not importer.marker or stores(networks, importer.marker)


def write_model(run: Path, file_format: str, output: Path, console: Console) -> list[dict[str, Any]]:
    """Write the last iteration of a run, of one of `RUNS`, as a model.pt; returns entries for `left_out`.

    Raises `ImportFailed` naming what is missing or differs.
    """
    clouds = {
        int(number[0]): p
        for p in run.glob("point_cloud/iteration_*/point_cloud.ply")
        if (number := re.findall(r"_([0-9]+)$", p.parent.name))
    }
    if not clouds:
        raise ImportFailed(run, "has no point_cloud/iteration_*/point_cloud.ply")
    iteration, importer = max(clouds), RUNS[file_format]
    for name in ("cfg_args", "cameras.json"):
        refuse_pointer(run / name)
    source = read_splats(clouds[iteration], "ply")
    # networks read the file's coordinates
    source = replace(source, gaussians=source.around(np.zeros(3)), offset=None)
    for warning in source.warnings:
        console.print(f"warning: {warning}", markup=False)
    if source.dropped:
        raise ImportFailed(clouds[iteration], f"{source.dropped:,} Gaussians have {UNUSABLE}")
    if source.motion is not None:
        raise ImportFailed(clouds[iteration], "has Gaussians that move by themselves, unlike those of such a run")
    folder = RunFolder(run, iteration, importer.networks)
    model, notes = importer.read(folder, canonical(source))
    for t in np.linspace(0, 1, CHECKED_TIMES).tolist():
        with _usable(run, f" at t = {t:g}"):
            posed(model, t).validate()
    metadata = metadata_of(source.gaussians.means, source.gaussians.sh_degree, "0" * 64)
    cameras = _cameras(run / "cameras.json")
    info = SceneInfo(
        background=WHITE if folder.settings.get("white_background", importer.white_background) else BLACK,
        bounds=[list(b) for b in metadata.bounds],
        cameras=cameras or [camera.to_plain() for camera in metadata.cameras],
        size=int(cameras[0]["width"]) if cameras else None,
    )
    console.print(f"{run}: iteration {iteration:,}, {len(source):,} Gaussians", markup=False)
    with console.status("comparing frames"), _usable(run):
        loss = importer.fidelity(model, info)
    save_model(output, model, info, iteration)
    for note in [*notes, *([loss.note] if loss else [])]:
        console.print(note, markup=False)
    return [loss.left_out()] if loss else []


@contextmanager
def _usable(run: Path, when: str = "") -> Iterator[None]:
    """Turn errors of Gaussians that can't be drawn into `ImportFailed`: finite weights may give infinite poses."""
    try:
        yield
    except InvalidInput as error:
        raise ImportFailed(run, f"its network gives Gaussians that can't be used{when}: {error}") from error


def canonical(source: Splats) -> CanonicalGaussians:
    """Activated Gaussians in storage space, with the stored norms of their quaternions."""
    g = source.gaussians
    lengths = np.ones(len(g), np.float32) if source.quat_lengths is None else source.quat_lengths
    arrays = (g.means, np.log(g.scales), g.quats * lengths[:, None], logit(g.opacities), g.sh[:, :1], g.sh[:, 1:])
    return CanonicalGaussians(*(torch.from_numpy(as_float32(array)) for array in arrays))


def _cameras(file: Path) -> list[dict[str, Any]]:
    """The cameras of INRIA's cameras.json, if there is one; its poses are camera to world in OpenCV axes."""
    if not file.is_file():
        return []
    try:
        cameras = []
        for stored in json.loads(file.read_text())[:MAX_CAMERAS]:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = stored["rotation"], stored["position"]
            size = int(stored["width"]), int(stored["height"])
            camera = Camera(stored["fx"], stored["fy"], size[0] / 2, size[1] / 2, *size, pose)
            name = re.sub(r"\s+", " ", str(stored["img_name"])) or "camera"
            cameras.append(SceneCamera(name, 0.0, camera).to_plain())
        return cameras
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, InvalidInput) as error:
        raise ImportFailed(file, f"isn't a list of cameras as INRIA's trainer writes it: {error!r}") from error
