"""The conversion of a scene file, as `msdgs-convert` runs it."""

import json
from pathlib import Path

import numpy as np
import onnx
from rich.console import Console
from rich.progress import track

from msdgs_export.exporters.gltf import read_gltf, write_gltf
from msdgs_export.exporters.ply import write_ply
from msdgs_export.exporters.round_trip import ConversionFailed, RoundTrip, require, visionary_of
from msdgs_export.exporters.site.folder import write_site
from msdgs_export.exporters.spz import write_spz
from msdgs_export.exporters.usd import read_usd, write_usd
from msdgs_export.exporters.visionary import visionary_model
from msdgs_export.exporters.visionary_scene import visionary_scene
from msdgs_export.importers.sequence import of_the_moment
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.jobs.packing import stored_anew
from msdgs_export.jobs.write import set_properties, storage_differences, write_measured
from msdgs_export.options import ConvertOptions, require_writable
from msdgs_export.plans.registry import PLANS
from msdgs_export.progress import tracked
from msdgs_export.target import MIN_PSNR, check_min_psnr
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.metadata import SceneMetadata
from msdgs_serve.scene.similarity import Similarity
from msdgs_serve.writing import made_folder, move_all, replacing, temporary_folder, write_text

LOSSLESS, LOSSY = 60.0, 45.0
"""Default minimum PSNR of a written file against the scene, dB."""

ONNX, VISIONARY = ".onnx", ".visionary.onnx"
SINGLE = (".ply", ".spz", ".glb")
COMPRESSED = ".compressed.ply"
USD = (".usdc", ".usda", ".usd")
VIDEOS = (".mp4", ".webm")
PLACEMENT = "placement.json"
"""Ending of the file that holds the `Similarity` from the positions of a written file to the world."""
FRAMES = 30
"""Default number of files in a folder, or frames of OpenUSD."""
COMPARED = 5
"""Number of times at which a moving scene is compared."""


def convert(options: ConvertOptions, console: Console) -> None:
    """Write, read back, compare. Raises `InvalidInput`, `SceneFileInvalid` and `ConversionFailed`; a file below the
    minimum PSNR doesn't replace an old one."""
    out = options.out
    if options.min_psnr is not None:
        check_min_psnr(options.min_psnr)
    if options.site:
        write_site(DeformationSession(options.scene), options, console)
        return
    _refuse_options_of_sites(options)
    if options.frames is not None and (options.t is not None or out.suffix in (*SINGLE, ONNX)):
        raise InvalidInput("frames", "left out but for a folder of PLY files and OpenUSD, without --t", options.frames)
    if options.frames is not None and options.frames < 2:
        raise InvalidInput("frames", "2 or more", options.frames)
    if out.suffix in VIDEOS:
        raise InvalidInput("out", f"other than a video: msdgs-render {options.scene} {out} writes one", out.name)
    if out.name.lower().endswith(COMPRESSED):
        raise InvalidInput(
            "out", "without .compressed: SuperSplat's compressed PLY isn't written, .spz is small", out.name
        )
    if out.suffix in (*SINGLE, *USD, ONNX):
        require_writable("out", out, options.scene)
    if out.suffix == ONNX and options.t is not None:
        raise InvalidInput("t", "left out for a file that holds all times", options.t)
    session = DeformationSession(options.scene)
    if _is_visionary(out):
        written = _visionary(session, options, console)
    elif out.suffix == ONNX:
        written = _stored_anew(session, options, console)
    elif out.suffix in USD:
        written = _usd(session, options, console)
    elif out.suffix in SINGLE:
        t0, _ = session.scene.metadata.time_range
        worst = _one(session, options, out, t0 if options.t is None else options.t)
        written = f"{_megabytes(out)}, {worst:.1f} dB"
    elif not out.suffix or out.is_dir():
        written = _sequence(session, options, console)
    else:
        names = f"{', '.join((*SINGLE, *USD, ONNX))} or {VISIONARY}"
        raise InvalidInput("out", f"a folder (of a name with a dot: an existing one), or named {names}", out.name)
    console.print(f"{out}: {written} against the scene", markup=False)
    _note_placement(out, session.scene.metadata, console)
    eps2d = session.scene.metadata.eps2d
    if eps2d != GSPLAT.eps2d:
        drawn = "blurrier" if eps2d < GSPLAT.eps2d else "sharper"
        console.print(f"it was trained with eps2d {eps2d:g}; programs that add {GSPLAT.eps2d:g} px² draw it {drawn}")


def _is_visionary(out: Path) -> bool:
    return out.suffix == ONNX and out.name.lower().endswith(VISIONARY)


def _refuse_options_of_sites(options: ConvertOptions) -> None:
    for name in ("title", "description", "url", "onnxruntime_web"):
        if getattr(options, name) is not None:
            raise InvalidInput(name, "given with --site", getattr(options, name))


def _written_units(file: Path, metadata: SceneMetadata) -> float:
    """Written units per scene unit: those of the world, but in SPZ and Visionary's model, whose numbers have a range or
    whose viewer has a near plane for scenes of a few units."""
    return 1.0 if file.suffix in (".spz", ONNX) else metadata.scene_to_world.scale


def _note_placement(out: Path, metadata: SceneMetadata, console: Console) -> None:
    """Tell where the file lies in the world, and write it beside formats that have no place for it."""
    place = metadata.scene_to_world
    left = Similarity(place.scale / _written_units(out, metadata), place.offset)
    file = out / PLACEMENT if out.is_dir() else out.with_name(f"{out.name}.{PLACEMENT}")
    if left.is_identity or (out.suffix == ONNX and not _is_visionary(out)):
        file.unlink(missing_ok=True)  # of an earlier file of this name
        return
    where = f"in the transform of its {'node' if out.suffix == '.glb' else 'prim'}"
    if out.suffix not in (*USD, ".glb"):
        write_text(file, json.dumps(left.to_plain()) + "\n")
        where = f"in {file}"
    x, y, z = left.offset
    console.print(
        f"x_world = {left.scale:g} x + ({x:.12g}, {y:.12g}, {z:.12g}) of its positions x is {where}", markup=False
    )


def _one(session: DeformationSession, options: ConvertOptions, file: Path, t: float) -> float:
    """Write a file of one time; returns its PSNR against the scene, dB."""
    metadata = session.scene.metadata
    place, scale = metadata.scene_to_world, _written_units(file, metadata)
    gaussians = of_the_moment(session.gaussians(t), metadata).scaled(scale)
    with replacing(file) as temporary:
        if file.suffix == ".spz":
            write_spz(temporary, gaussians, metadata.antialiasing)
        elif file.suffix == ".ply":
            write_ply(temporary, gaussians, metadata.antialiasing)
        else:
            write_gltf(temporary, gaussians, framing(metadata).up, place.offset)
        written = read_gltf(temporary) if file.suffix == ".glb" else read_splats(temporary).around(np.zeros(3))
        psnr = RoundTrip(session).psnr(written.scaled(1 / scale), t)
        require(psnr, options.min_psnr, LOSSY if file.suffix == ".spz" else LOSSLESS, file.name)
    return psnr


def _sequence(session: DeformationSession, options: ConvertOptions, console: Console) -> str:
    """Write a folder of PLY files: all of them, or none."""
    if options.t is not None:
        raise InvalidInput("t", "left out for a folder; --frames is the number of files", options.t)
    out, times = options.out, _times(session, options)
    if out.is_dir() and any(each.suffix == ".ply" for each in out.iterdir()):
        raise InvalidInput("out", "a folder without PLY files", str(out))
    digits = len(str(len(times) - 1))
    with made_folder(out), temporary_folder(out, out) as folder:
        worst = min(
            _one(session, options, folder / f"{options.scene.stem}_{number:0{digits}}.ply", t)
            for number, t in track(list(enumerate(times)), "writing frames", console=console, transient=True)
        )
        move_all([(file, out / file.name) for file in sorted(folder.glob("*.ply"))])
    return f"{len(times)} files, the worst {worst:.1f} dB"


def _usd(session: DeformationSession, options: ConvertOptions, console: Console) -> str:
    """Write the scene's whole time range, or one time."""
    out, metadata = options.out, session.scene.metadata
    moves = session.scene.moving_count and options.t is None
    if moves and metadata.is_switched:
        raise InvalidInput("t", "given: frames of this scene are switched, and USD would blend them", "nothing")
    if not moves and options.frames is not None:
        raise InvalidInput("frames", "left out for a scene that stands still", options.frames)
    single = metadata.time_range[0] if options.t is None else options.t
    times = _times(session, options) if moves else [single]
    check, scale = RoundTrip(session), _written_units(out, metadata)

    def pose(t: float) -> Gaussians:
        return of_the_moment(session.gaussians(t), metadata).scaled(scale)

    with tracked(console) as progress, replacing(out) as temporary:
        on_frame = progress("writing frames", len(times))
        write_usd(
            temporary,
            pose,
            times,
            session.scene.changing,
            on_frame,
            framing(metadata).up,
            metadata.scene_to_world.offset,
        )
        shown = read_usd(temporary)
        compared = np.linspace(0, len(times) - 1, min(COMPARED, len(times))).round().astype(int).tolist()
        worst = min(check.psnr(shown(number).scaled(1 / scale), times[number]) for number in compared)
        require(worst, options.min_psnr, LOSSLESS, out.name)
    return f"{len(times)} frames, {_megabytes(out)}, {worst:.1f} dB"


def _times(session: DeformationSession, options: ConvertOptions) -> list[float]:
    return np.linspace(*session.scene.metadata.time_range, options.frames or FRAMES).tolist()


def _visionary(session: DeformationSession, options: ConvertOptions, console: Console) -> str:
    """Write a model for Visionary, and the scene.json of its editor."""
    out, metadata = options.out, session.scene.metadata
    model, check = visionary_model(options.scene), RoundTrip(session, mip=False)
    times = np.linspace(*metadata.time_range, COMPARED if session.scene.moving_count else 1).tolist()
    with replacing(out) as temporary:
        temporary.write_bytes(model.SerializeToString())
        shown = visionary_of(temporary)
        worst = min(check.psnr(shown(t), t) for t in times)
        require(worst, options.min_psnr, LOSSY, out.name)
    scene_json = out.with_name(f"{out.name[: -len(VISIONARY)]}.scene.json")
    write_text(scene_json, json.dumps(visionary_scene(out.name, metadata), indent=2) + "\n")
    console.print(f"{scene_json}: the scene.json of a folder for Visionary's editor", markup=False)
    if metadata.antialiasing == "mip":
        console.print("its anti-aliasing isn't in this format: thin parts are brighter")
    plan = PLANS.get(metadata.plan.partition(":")[0])
    if session.scene.moving_count and plan is not None and not plan.fitted:
        console.print("a browser runs all layers every frame: msdgs-export --plan compact:65 makes a faster scene")
    return f"{_megabytes(out)}, {worst:.1f} dB"


def _stored_anew(session: DeformationSession, options: ConvertOptions, console: Console) -> str:
    """Write the scene with packed arrays."""
    out, contents = options.out, onnx.load(options.scene)
    min_psnr = MIN_PSNR if options.min_psnr is None else options.min_psnr
    with console.status("storage in fewer bits"):
        found = stored_anew(contents, min_psnr)
    if found is None:
        raise ConversionFailed(f"no array of {options.scene.name} can have fewer bits with {min_psnr:g} dB")
    packed, error = found
    others = {name: each for name, each in session.scene.metadata.measured_error.items() if name != "rendered"}
    set_properties(contents, measured_error=others)  # frames aren't compared with those of the model again
    write_measured(out, contents, lambda exact: {"storage": storage_differences(out, packed, exact)}, packed)
    return f"{_megabytes(out)} of {_megabytes(options.scene)}, {error.psnr_worst:.1f} dB"


def _megabytes(file: Path) -> str:
    return f"{file.stat().st_size / 1e6:.2f} MB"
