"""Damaged files of every imported kind are refused or rendered finite, in bounded time and memory.

Of each kind of run, whose networks are read in a process that first loads torch, a tenth as many are tested.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rich.console import Console

from msdgs_export.cli.export import export_or_import
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.model import RUNS, write_model
from msdgs_export.importers.splats.formats import read_splats
from msdgs_export.measure.poses import posed as posed_model
from msdgs_export.options import ExportOptions
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model_file import CheckpointInvalid, load_model, save_model
from tests.support.foreign_runs import (
    deformgs_state,
    fourdgs_state,
    grid4d_states,
    write_deformgs,
    write_fourdgs,
    write_grid4d,
)
from tests.support.fuzzing import CASES, IS_FRESH, SEED
from tests.support.memory import measured
from tests.support.models import SCENE, random_model
from tests.support.splat_files import FORMATS, drawn, sog_bytes, some_gaussians, write_sog, write_splats
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow
QUIET = Console(quiet=True)
COUNT = 1_000 if IS_FRESH else 300
"""Gaussians in a file."""

PALETTE = 64
"""Entries of the SH palette of a SOG."""

ENDS = 1024
"""Bytes at each end of a file, which hold headers and tables; half of the damage is there."""


class Kind(NamedTuple):
    """How files of a kind are written and read."""

    make: Callable[[Path, Gaussians], list[Path]]  # in an empty folder; returns the files to damage
    read: Callable[[Path, list[Path]], Gaussians]  # of the folder and these files


def one(file_format: str) -> Kind:
    """Return the kind of a format of one file, which is detected from the damaged file."""
    return Kind(
        lambda folder, g: [write_splats(folder, file_format, g)], lambda folder, files: read_splats(files[0]).gaussians
    )


def sog_folder(folder: Path, g: Gaussians) -> list[Path]:
    return sorted(write_sog(folder / "sog", g, PALETTE).iterdir())


def sog_zip(folder: Path, g: Gaussians) -> list[Path]:
    (folder / "a.sog").write_bytes(sog_bytes(g, PALETTE))
    return [folder / "a.sog"]


def frames(folder: Path, g: Gaussians) -> list[Path]:
    files = []
    for i in range(3):
        moved = Gaussians(g.means + np.float32(0.01 * i), g.quats, g.scales, g.opacities, g.sh)
        files.append(write_splats(folder, "ply", moved).rename(folder / f"frame_{i}.ply"))
    return files


def read_frames(folder: Path, files: list[Path]) -> Gaussians:
    export_or_import(ExportOptions(folder, folder / "scene.onnx", "sequence", keep=("float32",)), QUIET)
    return DeformationSession(folder / "scene.onnx").gaussians(0.5)


def run_of(kind: str, write_run: Callable[..., Path], state: Any) -> Kind:
    """Return the kind of a run, of which the files of the last iteration are damaged that are read."""

    def make(folder: Path, g: Gaussians) -> list[Path]:
        run = write_run(folder / "run", state)
        network, cloud = RUNS[kind].networks, "point_cloud/iteration_*/point_cloud.ply"
        return [*(next(run.glob(name.replace("*", "?0000"))) for name in (network, cloud)), run / "cfg_args"]

    def read(folder: Path, files: list[Path]) -> Gaussians:
        write_model(folder / "run", kind, folder / "model.pt", QUIET)
        return posed_model(load_model(folder / "model.pt").model, 0.5)

    return Kind(make, read)


def our_model(folder: Path, g: Gaussians) -> list[Path]:
    save_model(folder / "model.pt", random_model(len(g)), SCENE, 1)
    return [folder / "model.pt"]


def read_our_model(folder: Path, files: list[Path]) -> Gaussians:
    try:
        return posed_model(load_model(files[0]).model, 0.5).validate()
    except (CheckpointInvalid, InvalidInput) as error:
        raise ImportFailed(files[0], str(error)) from error


KINDS = {
    **{name: one(name) for name in FORMATS},
    "model": Kind(our_model, read_our_model),
    "sog": Kind(sog_zip, lambda folder, files: read_splats(files[0]).gaussians),
    "sog folder": Kind(sog_folder, lambda folder, files: read_splats(folder / "sog").gaussians),
    "sequence": Kind(frames, read_frames),
    "deformgs": run_of("deformgs", write_deformgs, deformgs_state(True)),
    "4dgs": run_of("4dgs", write_fourdgs, fourdgs_state((1,))),
    "grid4d": run_of("grid4d", write_grid4d, grid4d_states()),
}


@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_refused_or_drawn(tmp_path: Path, name: str):
    kind, rng = KINDS[name], np.random.default_rng(SEED + sum(name.encode()))
    files = kind.make(tmp_path, some_gaussians(COUNT, sh_degree=1))
    whole = {file: file.read_bytes() for file in files}
    drawn(kind.read(tmp_path, files))  # compiles
    count, sound_reads = (max(CASES // 10, len(files)), 1) if name in RUNS else (CASES, 3)
    sound = max(measured(lambda: kind.read(tmp_path, files))[1] for _ in range(sound_reads))
    allowed = 2 * sound + tolerance("damaged_file.megabytes")
    worst, slowest, refused = 0.0, 0.0, 0
    for i in range(count):
        file = files[i % len(files)]
        file.write_bytes(damaged(whole[file], rng))
        (was_refused, seconds), memory = measured(lambda: refused_or_drawn(kind, tmp_path, files))
        if memory > allowed:  # what the file takes, it takes again; what another thread of the process took, not
            memory = min(memory, *(measured(lambda: refused_or_drawn(kind, tmp_path, files))[1] for _ in range(2)))
        refused += was_refused
        worst, slowest = max(worst, memory), max(slowest, seconds)
        file.write_bytes(whole[file])
    print(
        f"\n{name}: {count:,} files, {refused:,} refused, {count - refused:,} drawn, slowest {slowest:.2f} s, "
        f"memory {worst:.1f} MB at most, the sound file {sound:.1f} MB"
    )
    assert slowest < tolerance("damaged_file.seconds")
    assert worst <= allowed


def refused_or_drawn(kind: Kind, folder: Path, files: list[Path]) -> tuple[bool, float]:
    """Return whether the files are refused, and the seconds that reading them took."""
    start = time.process_time()
    try:
        read = kind.read(folder, files)
    except ImportFailed:
        return True, time.process_time() - start
    seconds = time.process_time() - start
    assert np.isfinite(drawn(read)).all()
    return False, seconds


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """Flip 1 to 7 bits, in half of the cases near the ends, and in a third of the cases cut the file off."""
    changed = bytearray(whole)
    at_ends = rng.random() < 0.5
    for _ in range(rng.integers(1, 8)):
        place = int(rng.integers(min(ENDS, len(changed)) if at_ends else len(changed)))
        changed[-1 - place if at_ends and rng.random() < 0.5 else place] ^= 1 << int(rng.integers(8))
    return bytes(changed[: rng.integers(len(changed))] if rng.random() < 1 / 3 else changed)
