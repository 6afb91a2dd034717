"""The export of a model or of another program's scene, as `msdgs-export` runs it."""

import math
from dataclasses import fields

import numpy as np
from rich.console import Console

from msdgs_export.importers.command import Import, import_scene, trained_model
from msdgs_export.importers.detect import TRAINED, input_format
from msdgs_export.importers.scene import changed_metadata, note_left_out
from msdgs_export.importers.splats.axes import up_direction
from msdgs_export.jobs.command import export
from msdgs_export.options import ExportOptions, require_writable
from msdgs_export.plans.registry import parse
from msdgs_export.target import MIN_PSNR, check_min_psnr
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.metadata import MAX_NUMBER

FOR_SPLATS = ("model", "output", "format", "min_psnr", "keep", "duration", "up")
"""The options that splats and sequences have; nothing is pruned or fitted."""


def export_or_import(options: ExportOptions, console: Console) -> None:
    """Export a trained model, or write a splat or a sequence as a scene file.

    Raises `InvalidInput`, `ImportFailed`, `CheckpointInvalid` and `SceneFileInvalid`.
    """
    path, output = options.model, options.scene_file
    file_format = input_format(path, options.format)
    require_writable("output", output, path)
    if output.suffix != ".onnx":
        raise InvalidInput("output", "named *.onnx", output.name)
    _check(options, file_format)
    if file_format in TRAINED:
        with trained_model(path, file_format, console) as (model, lost):
            export(model, options.spelled_out, console)
        if lost:
            note_left_out(output, lost)
    else:
        min_psnr = MIN_PSNR if options.min_psnr is None else options.min_psnr
        up = None if options.up is None else _up(options.up)
        import_scene(Import(path, file_format, output, min_psnr if options.packs else None, up), console)
    if options.duration is not None:
        changed_metadata(output, duration=options.duration)


def _check(options: ExportOptions, file_format: str) -> None:
    """Refuse options that this input doesn't have, and values that can't be used."""
    if file_format in TRAINED:
        _check_for_trained(options, file_format)
    else:
        _check_for_splats(options)
    _check_values(options)


def _check_values(options: ExportOptions) -> None:
    if options.duration is not None and not 0 < options.duration <= MAX_NUMBER:
        raise InvalidInput("duration", "seconds above 0", options.duration)
    if options.min_psnr is not None:
        check_min_psnr(options.min_psnr)
    if options.max_mb is not None and not 0 < options.max_mb < math.inf:
        raise InvalidInput("max_mb", "a positive number of megabytes, 10⁶ bytes each", options.max_mb)
    if not options.tolerance >= 0:
        raise InvalidInput("tolerance", "0 or more", options.tolerance)
    if options.times < 2:
        raise InvalidInput("times", "2 or more", options.times)
    if options.chosen_plan is not None:
        parse(options.chosen_plan)


def _check_for_trained(options: ExportOptions, file_format: str) -> None:
    if options.up is not None:
        raise InvalidInput("up", "left out: it is for splats; a trained model is upright in its cameras", options.up)
    if file_format == "4dgs" and options.data is not None and (options.data / "dataset.json").exists():
        raise InvalidInput("data", "left out: 4DGaussians trains in HyperNeRF's unscaled coordinates", options.data)


def _check_for_splats(options: ExportOptions) -> None:
    for field in fields(options):
        if field.name not in FOR_SPLATS and getattr(options, field.name) != field.default:
            raise InvalidInput(field.name, "left out: it is for trained models", str(getattr(options, field.name)))
    if pruning := " ".join(part for part in options.keep if part != "float32"):
        raise InvalidInput("keep", "left out, or float32: nothing of a splat is pruned", pruning)
    if not options.packs and options.min_psnr is not None:
        raise InvalidInput("min_psnr", "left out with --keep float32", options.min_psnr)


def _up(text: str) -> np.ndarray:
    found = up_direction(text)
    if found is None:
        raise InvalidInput("up", "x, y, z, -x, -y, -z or three finite numbers that aren't all 0", repr(text))
    return found
