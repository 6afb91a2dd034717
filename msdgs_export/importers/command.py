"""The inputs of `msdgs-export` other than a model.pt."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from msdgs_export.importers.detect import checked_format, detect_format, frame_files
from msdgs_export.importers.polynomial import at_time, polynomial_scene
from msdgs_export.importers.runs.model import RUNS, write_model
from msdgs_export.importers.scene import digest, note_left_out, static_scene, write_imported
from msdgs_export.importers.sequence import posed, read_sequence, sequence_scene, shown_rows
from msdgs_export.importers.splats.axes import up_direction
from msdgs_export.importers.splats.formats import READERS, read_splats, refuse_pointer
from msdgs_export.importers.splats.sog import META
from msdgs_export.options import ExportOptions, require_folder_of
from msdgs_export.progress import tracked
from msdgs_export.target import MIN_PSNR
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import scratch_folder

FOR_SPLATS = ("model", "output", "format", "min_psnr", "keep", "duration", "up")
"""The options that splats and sequences have; nothing is pruned or fitted."""

POLYNOMIAL_TIMES = 9
"""At which a scene of moving Gaussians is compared with its file."""


@contextmanager
def model_or_import(options: ExportOptions, console: Console) -> Iterator[Path | None]:
    """The model.pt to export: the given one, or a temporary one that is made from another trainer's run.

    Splats and sequences are written as scene files directly, in fewer bits unless these are switched off; the result is
    then None. Raises `ImportFailed`, `InvalidInput` and `SceneFileInvalid`.
    """
    path, file_format, output = options.model, options.format, options.scene_file
    if path.is_file():
        refuse_pointer(path)
    if file_format == "detect":
        file_format = "model" if not path.exists() or path.suffix == ".pt" else detect_format(path)
    file_format = checked_format(file_format)
    require_folder_of("output", output)
    if options.up is not None and file_format in ("model", *RUNS):
        raise InvalidInput("up", "left out: it is for splats; a trained model is upright in its cameras", options.up)
    if file_format == "model":
        yield path / "model.pt" if path.is_dir() else path
    elif file_format in RUNS:
        if file_format == "4dgs" and options.data is not None and (options.data / "dataset.json").exists():
            raise InvalidInput("data", "left out: 4DGaussians trains in HyperNeRF's unscaled coordinates", options.data)
        with scratch_folder() as folder:
            model = folder / "model.pt"
            lost = write_model(path, file_format, model, console)
            yield model
            if lost:
                note_left_out(output, lost)
    else:
        for field in fields(options):
            if field.name not in FOR_SPLATS and getattr(options, field.name) != field.default:
                raise InvalidInput(field.name, "left out: it is for trained models", str(getattr(options, field.name)))
        if pruning := " ".join(part for part in options.keep if part != "float32"):
            raise InvalidInput("keep", "left out, or float32: nothing of a splat is pruned", pruning)
        if not options.packs and options.min_psnr is not None:
            raise InvalidInput("min_psnr", "left out with --keep float32", options.min_psnr)
        min_psnr = None if not options.packs else MIN_PSNR if options.min_psnr is None else options.min_psnr
        imported = Import(path, file_format, output, min_psnr, None if options.up is None else _up(options.up))
        write = _splats if file_format in READERS else _sequence
        _print(write(imported, console), output, console)
        yield None


class Import(NamedTuple):
    """The import of a splat or a sequence."""

    path: Path
    format: str
    output: Path
    min_psnr: float | None  # dB, of frames of packed arrays; None: arrays stay float32
    up: np.ndarray | None  # [3] unit; None: what the file says


def _up(text: str) -> np.ndarray:
    found = up_direction(text)
    if found is None:
        raise InvalidInput("up", "x, y, z, -x, -y, -z or three finite numbers that aren't all 0", repr(text))
    return found


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
