"""Damaged files of every kind that is imported: an error by name or a finite image, in no more time and memory.

`MSDGS_DAMAGED=5000 pytest -n 0 -s tests/export/test_importers_damaged.py` takes so many of each kind, and larger ones.
"""

import gzip
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from rich.console import Console

from export.exporters.spz import write_spz
from export.importers.errors import ImportFailed
from export.importers.runs.model import write_model
from export.importers.scene import write_imported
from export.importers.sequence import posed, read_sequence, sequence_scene, shown_rows
from export.importers.splats.formats import read_splats
from export.measure.poses import posed as posed_model
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model_file import CheckpointInvalid, load_model, save_model
from tests.export import test_importers_4dgs, test_importers_runs
from tests.support.memory import measured
from tests.support.models import SCENE, random_model
from tests.support.splat_files import (
    compressed_ply_bytes,
    inria_columns,
    ksplat_bytes,
    ply_bytes,
    some_gaussians,
    splat_bytes,
    spz2_bytes,
    spz4_bytes,
    write_sog,
    zipped,
)
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow
QUIET = Console(quiet=True)
DAMAGED = int(os.environ.get("MSDGS_DAMAGED", "30"))
"""Files of each kind."""

COUNT = 300 if DAMAGED < 1000 else 1_000
"""Gaussians a file."""

PALETTE = 64
"""Sets of harmonics in a SOG."""

ENDS = 1024
"""Bytes at both ends, where headers and tables are and half of the damage is done."""


class Kind(NamedTuple):
    """How to make one and how to look at it."""

    make: Callable[[Path, Gaussians], list[Path]]  # in a folder that is empty; returns the files that may be damaged
    read: Callable[[Path, list[Path]], Gaussians]  # of the folder and these files


def one(name: str, contents: Callable[[Gaussians], bytes]) -> Kind:
    """A format of one file, which is recognised by what is left of it."""

    def make(folder: Path, g: Gaussians) -> list[Path]:
        (folder / name).write_bytes(contents(g))
        return [folder / name]

    return Kind(make, lambda folder, files: read_splats(files[0]).gaussians)


def spz3(g: Gaussians) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_spz(Path(folder) / "a.spz", g, "dilate")
        return (Path(folder) / "a.spz").read_bytes()


def spz2(g: Gaussians) -> bytes:
    return gzip.compress(spz2_bytes(gzip.decompress(spz3(g)), g.quats))


def sog_folder(folder: Path, g: Gaussians) -> list[Path]:
    return sorted(write_sog(folder / "sog", g, PALETTE).iterdir())


def sog_zip(folder: Path, g: Gaussians) -> list[Path]:
    (folder / "a.sog").write_bytes(zipped(write_sog(folder / "sog", g, PALETTE)))
    return [folder / "a.sog"]


def frames(folder: Path, g: Gaussians) -> list[Path]:
    files = []
    for i in range(3):
        moved = Gaussians(g.means + np.float32(0.01 * i), g.quats, g.scales, g.opacities, g.sh)
        files.append(folder / f"frame_{i}.ply")
        files[-1].write_bytes(ply_bytes(inria_columns(moved)))
    return files


def read_frames(folder: Path, files: list[Path]) -> Gaussians:
    sequence, output = read_sequence(folder), folder / "scene.onnx"
    times = sequence.times()
    write_imported(
        output,
        sequence_scene(sequence, "0" * 64),
        lambda t: posed(sequence, times.index(t)),
        times,
        rows=lambda t: shown_rows(sequence, times.index(t)),
    )
    return DeformationSession(output).gaussians(0.5)


def run_of(write_run: Callable[..., Path], state: dict[str, torch.Tensor]) -> Callable[[Path, Gaussians], list[Path]]:
    def make(folder: Path, g: Gaussians) -> list[Path]:
        run = write_run(folder / "run", state)
        return [*sorted(run.glob("*/*_?0000/*.p*")), run / "cfg_args"]

    return make


def read_run(kind: str) -> Callable[[Path, list[Path]], Gaussians]:
    def read(folder: Path, files: list[Path]) -> Gaussians:
        write_model(folder / "run", kind, folder / "model.pt", QUIET)
        return posed_model(load_model(folder / "model.pt").model, 0.5)

    return read


def our_model(folder: Path, g: Gaussians) -> list[Path]:
    save_model(folder / "model.pt", random_model(len(g)), SCENE, 1)
    return [folder / "model.pt"]


def read_our_model(folder: Path, files: list[Path]) -> Gaussians:
    try:
        return posed_model(load_model(files[0]).model, 0.5).validate()
    except (CheckpointInvalid, InvalidInput) as error:
        raise ImportFailed(files[0], str(error)) from error


FORMATS = {
    "model": Kind(our_model, read_our_model),
    "ply": one("a.ply", lambda g: ply_bytes(inria_columns(g))),
    "text ply": one("a.ply", lambda g: ply_bytes(inria_columns(g), "ascii")),
    "compressed ply": one("a.compressed.ply", compressed_ply_bytes),
    "splat": one("a.splat", splat_bytes),
    "ksplat": one("a.ksplat", ksplat_bytes),
    "spz 2": one("a.spz", spz2),
    "spz 3": one("a.spz", spz3),
    "spz 3, bare": one("a.spz", lambda g: gzip.decompress(spz3(g))),
    "spz 4": one("a.spz", lambda g: spz4_bytes(gzip.decompress(spz3(g)))),
    "sog": Kind(sog_zip, lambda folder, files: read_splats(files[0]).gaussians),
    "sog folder": Kind(sog_folder, lambda folder, files: read_splats(folder / "sog").gaussians),
    "sequence": Kind(frames, read_frames),
    "deformgs": Kind(
        run_of(test_importers_runs.write_run, test_importers_runs.their_state(True)), read_run("deformgs")
    ),
    "4dgs": Kind(run_of(test_importers_4dgs.write_run, test_importers_4dgs.their_state((1,))), read_run("4dgs")),
}


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_refused_or_drawn(tmp_path: Path, name: str):
    kind, rng = FORMATS[name], np.random.default_rng(sum(name.encode()))
    files = kind.make(tmp_path, some_gaussians(COUNT, sh_degree=1))
    whole = {file: file.read_bytes() for file in files}
    drawn(kind.read(tmp_path, files))  # compiles
    sound = max(measured(lambda: kind.read(tmp_path, files))[1] for _ in range(3))
    worst, slowest, refused = 0.0, 0.0, 0
    for _ in range(DAMAGED):
        file = files[rng.integers(len(files))]
        file.write_bytes(damaged(whole[file], rng))
        taken, memory = measured(lambda: refused_or_drawn(kind, tmp_path, files))
        refused += taken.refused
        worst, slowest = max(worst, memory), max(slowest, taken.seconds)
        file.write_bytes(whole[file])
    print(
        f"\n{name}: {DAMAGED:,} files, {refused:,} refused, {DAMAGED - refused:,} drawn, slowest {slowest:.2f} s, "
        f"memory {worst:.1f} MB at most, the sound file {sound:.1f} MB"
    )
    assert slowest < tolerance("damaged_file.seconds")
    assert worst <= 2 * sound + tolerance("damaged_file.megabytes")


class Taken(NamedTuple):
    refused: bool
    seconds: float


def refused_or_drawn(kind: Kind, folder: Path, files: list[Path]) -> Taken:
    start = time.process_time()
    try:
        read = kind.read(folder, files)
    except ImportFailed:
        return Taken(True, time.process_time() - start)
    seconds = time.process_time() - start
    assert np.isfinite(drawn(read)).all()
    return Taken(False, seconds)


def drawn(g: Gaussians) -> np.ndarray:
    camera = Camera.from_fov(orbit(np.zeros(3), 3.0, 30, 20, np.array([0.0, -1.0, 0.0])), 64, 48, 50)
    return rasterize(g, camera).rgb


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """Some bits turned, half of the time at the ends, and in one of three cases cut off."""
    changed = bytearray(whole)
    at_ends = rng.random() < 0.5
    for _ in range(rng.integers(1, 8)):
        place = int(rng.integers(min(ENDS, len(changed)) if at_ends else len(changed)))
        changed[-1 - place if at_ends and rng.random() < 0.5 else place] ^= 1 << int(rng.integers(8))
    return bytes(changed[: rng.integers(len(changed))] if rng.random() < 1 / 3 else changed)
