"""The inputs of `msdgs-export`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from msdgs_export.importers.detect import frame_files
from msdgs_export.importers.polynomial import at_time, polynomial_scene
from msdgs_export.importers.runs.model import write_model
from msdgs_export.importers.scene import digest, static_baked, static_scene, write_imported
from msdgs_export.importers.sequence import posed, read_sequence, sequence_scene, shown_rows
from msdgs_export.importers.splats.formats import READERS, read_splats
from msdgs_export.importers.splats.sog import META
from msdgs_export.importers.static_file import StaticSceneFile
from msdgs_export.progress import tracked
from msdgs_export.storage.choice import MAX_VALUES
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.writing import scratch_folder

POLYNOMIAL_TIMES = 9
"""At which a scene of moving Gaussians is compared with its file."""


@contextmanager
def trained_model(path: Path, file_format: str, console: Console) -> Iterator[tuple[Path, list[dict[str, Any]]]]:
    """The model.pt of an input of one of `TRAINED`, the given one or a temporary one that is made from another
    trainer's run; and entries for `left_out`. Raises `ImportFailed`."""
    if file_format == "model":
        yield (path / "model.pt" if path.is_dir() else path), []
    else:
        with scratch_folder() as folder:
            model = folder / "model.pt"
            yield model, write_model(path, file_format, model, console)


class Import(NamedTuple):
    """The import of a splat or a sequence."""

    path: Path
    format: str
    output: Path
    min_psnr: float | None  # dB, of frames of packed arrays; None: arrays stay float32
    up: np.ndarray | None  # [3] unit; None: what the file says


def import_scene(job: Import, console: Console) -> None:
    """Write a splat or a sequence as a scene file. Raises `ImportFailed`, `InvalidInput` and `SceneFileInvalid`."""
    write = _splats if job.format in READERS else _sequence
    _print(write(job, console), job.output, console)


def _warn(warnings: Sequence[str], console: Console) -> None:
    for warning in warnings:
        console.print(f"warning: {warning}", markup=False)


def _splats(job: Import, console: Console) -> BakedScene:
    path = job.path
    if job.format == "sog" and path.name == META:
        path = path.parent  # its limits and its digest are those of all files
    with console.status(f"reading {path}"):
        source = read_splats(path, job.format)
        _warn(source.warnings, console)
        source = source if job.up is None else replace(source, up=job.up)
        values = sum(array.size for array in vars(source.gaussians).values())
        if source.motion is None and (job.min_psnr is None or values > MAX_VALUES):
            scene = StaticSceneFile(static_baked(source, digest(path)))
            del source  # its opacities and SH are released while the file is written
            return scene.write(job.output)
        if source.motion is None:
            scene = static_scene(source, digest(path))
            return write_imported(job.output, scene, lambda t: source.gaussians, [0.0], min_psnr=job.min_psnr)
        scene = polynomial_scene(source, digest(path))
        times = np.linspace(0, 1, POLYNOMIAL_TIMES).tolist()
        return write_imported(job.output, scene, lambda t: at_time(source, t), times, min_psnr=job.min_psnr)


def _sequence(job: Import, console: Console) -> BakedScene:
    how = job.format.partition(":")[2] or None
    with tracked(console) as track:
        sequence = read_sequence(job.path, how, track("reading frames", len(frame_files(job.path))))
        sequence = sequence if job.up is None else replace(sequence, up=job.up)
        times = sequence.times()
        scene = write_imported(
            job.output,
            sequence_scene(sequence, digest(job.path)),
            lambda t: posed(sequence, times.index(t)),
            times,
            track("comparing frames", len(times)),
            rows=lambda t: shown_rows(sequence, times.index(t)),
            min_psnr=job.min_psnr,
        )
    _warn(sequence.warnings, console)
    way = "blended" if sequence.blended else "switched, since they don't correspond or blending is off"
    console.print(f"{len(times)} frames, {way}")
    return scene


def _print(scene: BakedScene, output: Path, console: Console) -> None:
    for entry in scene.metadata.left_out:
        console.print(f"left out: {entry['what']}: {entry['count']:,} of {entry['of']:,}", markup=False)
    console.print(
        f"{output}: plan {scene.metadata.plan}, {output.stat().st_size / 1e6:.2f} MB, {scene.moving_count:,} moving "
        f"and {scene.static_count:,} static Gaussians, SH of degree {scene.metadata.sh_degree}",
        markup=False,
    )
