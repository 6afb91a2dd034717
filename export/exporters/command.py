"""The conversion of a scene file, as `convert.py` runs it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress, track

from export.exporters.gltf import read_gltf, write_gltf
from export.exporters.ply import write_ply
from export.exporters.round_trip import RoundTrip, require, visionary_of
from export.exporters.spz import write_spz
from export.exporters.usd import read_usd, write_usd
from export.exporters.visionary import visionary_model
from export.exporters.visionary_scene import visionary_scene
from export.importers.sequence import is_switched, of_the_moment
from export.importers.splats.formats import read_splats
from export.plans.registry import PLANS
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.datasets.common.files import replacing

LOSSLESS, LOSSY = 60.0, 45.0
"""Default floors of PSNR of a written file against the scene, dB."""

VISIONARY = ".visionary.onnx"
SINGLE = (".ply", ".spz", ".glb")
USD = (".usdc", ".usda", ".usd")
FILMS = (".mp4", ".webm")
COMPARED = 5
"""Number of times at which a moving scene is compared."""


@dataclass(frozen=True)
class Settings:
    """Options of the command line."""

    scene: Path
    out: Path
    t: float | None
    frames: int
    min_psnr: float | None  # dB


def convert(settings: Settings, console: Console) -> None:
    """Write, read back, compare. Raises `InvalidInput`, `SceneFileInvalid` and `ConversionFailed`; a file below the
    floor of PSNR doesn't replace an old one."""
    out = settings.out
    if out.suffix in FILMS:
        raise InvalidInput("out", f"other than a film: msdgs-render {settings.scene} {out} writes one", out.name)
    session = DeformationSession(settings.scene)
    if out.name.endswith(VISIONARY):
        _visionary(session, settings, console)
    elif out.suffix in USD:
        _usd(session, settings, console)
    elif out.suffix in SINGLE:
        t0, _ = session.scene.metadata.time_range
        psnr = _one(session, out, t0 if settings.t is None else settings.t, settings.min_psnr)
        console.print(f"{out}: {out.stat().st_size / 1e6:.2f} MB, {psnr:.1f} dB from the scene", markup=False)
    elif not out.suffix:
        _sequence(session, settings, console)
    else:
        raise InvalidInput("out", f"a folder, or named {', '.join((*SINGLE, *USD))} or {VISIONARY}", out.name)
    eps2d = session.scene.metadata.eps2d
    if eps2d != GSPLAT.eps2d:
        drawn = "softer" if eps2d < GSPLAT.eps2d else "harder"
        console.print(f"it was trained with eps2d {eps2d:g}; programs that add {GSPLAT.eps2d:g} px² draw it {drawn}")


def _one(session: DeformationSession, file: Path, t: float, min_psnr: float | None) -> float:
    metadata = session.scene.metadata
    gaussians = of_the_moment(session.gaussians(t), metadata.plan)
    with replacing(file) as temporary:
        if file.suffix == ".spz":
            write_spz(temporary, gaussians, metadata.antialiasing)
        else:
            (write_ply if file.suffix == ".ply" else write_gltf)(temporary, gaussians)
        default = LOSSY if file.suffix == ".spz" else LOSSLESS
        written = read_gltf(temporary) if file.suffix == ".glb" else read_splats(temporary).gaussians
        psnr = RoundTrip(session).psnr(written, t)
        require(psnr, default if min_psnr is None else min_psnr, file.name)
    return psnr


def _sequence(session: DeformationSession, settings: Settings, console: Console) -> None:
    if settings.t is not None:
        raise InvalidInput("t", "left out for a folder; --frames says how many", settings.t)
    if settings.frames < 2:
        raise InvalidInput("frames", "2 or more", settings.frames)
    times = np.linspace(*session.scene.metadata.time_range, settings.frames).tolist()
    out, digits = settings.out, len(str(settings.frames - 1))
    out.mkdir(parents=True, exist_ok=True)
    if any(each.suffix == ".ply" for each in out.iterdir()):
        raise InvalidInput("out", "a folder without PLY files", str(out))
    worst = min(
        _one(session, out / f"{settings.scene.stem}_{number:0{digits}}.ply", t, settings.min_psnr)
        for number, t in track(list(enumerate(times)), "writing frames", console=console, transient=True)
    )
    console.print(f"{out}: {len(times)} files, the worst {worst:.1f} dB from the scene", markup=False)


def _usd(session: DeformationSession, settings: Settings, console: Console) -> None:
    """The scene's whole time range, or one time."""
    out, (t0, t1) = settings.out, session.scene.metadata.time_range
    moves = session.scene.moving_count and settings.t is None
    plan = session.scene.metadata.plan
    if moves and is_switched(plan):
        raise InvalidInput("t", "given: frames of this scene are switched, and USD would blend them", "nothing")
    if moves and settings.frames < 2:
        raise InvalidInput("frames", "2 or more", settings.frames)
    times = np.linspace(t0, t1, settings.frames).tolist() if moves else [t0 if settings.t is None else settings.t]
    check = RoundTrip(session)
    with Progress(console=console, transient=True) as progress, replacing(out) as temporary:
        task = progress.add_task("writing frames", total=len(times))
        write_usd(temporary, lambda t: of_the_moment(session.gaussians(t), plan), times, lambda: progress.advance(task))
        shown = read_usd(temporary)
        compared = np.linspace(0, len(times) - 1, min(COMPARED, len(times))).round().astype(int).tolist()
        worst = min(check.psnr(shown(number), times[number]) for number in compared)
        require(worst, LOSSLESS if settings.min_psnr is None else settings.min_psnr, out.name)
    size = out.stat().st_size / 1e6
    console.print(f"{out}: {len(times)} frames, {size:.2f} MB, {worst:.1f} dB from the scene", markup=False)


def _visionary(session: DeformationSession, settings: Settings, console: Console) -> None:
    out, metadata = settings.out, session.scene.metadata
    model = visionary_model(settings.scene)
    with replacing(out) as temporary:
        temporary.write_bytes(model.SerializeToString())
        worst = _worst(session, visionary_of(temporary))
        require(worst, LOSSY if settings.min_psnr is None else settings.min_psnr, out.name)
    scene_json = out.with_name(f"{out.name.removesuffix(VISIONARY)}.scene.json")
    with replacing(scene_json) as temporary:
        temporary.write_text(json.dumps(visionary_scene(out.name, metadata), indent=2) + "\n")
    console.print(f"{out}: {out.stat().st_size / 1e6:.2f} MB, {worst:.1f} dB from the scene", markup=False)
    console.print(f"{scene_json}: the scene.json of a folder for Visionary's editor", markup=False)
    if metadata.antialiasing == "mip":
        console.print("its anti-aliasing isn't in this format: thin parts come out brighter")
    plan = PLANS.get(metadata.plan.partition(":")[0])
    if session.scene.moving_count and plan is not None and not plan.fitted:
        console.print("a browser runs all layers every frame: to_onnx.py --plan lowrank makes a scene that is cheaper")


def _worst(session: DeformationSession, shown: Callable[[float], Gaussians]) -> float:
    check = RoundTrip(session, mip=False)
    times = np.linspace(*session.scene.metadata.time_range, COMPARED if session.scene.moving_count else 1)
    return min(check.psnr(shown(float(np.float32(t))), float(np.float32(t))) for t in times)
