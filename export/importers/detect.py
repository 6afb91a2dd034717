"""Which format a file or folder is, by what is in it; names decide only where contents can't."""

import re
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from export.importers.errors import ImportFailed
from export.importers.splats.base import Splats
from export.importers.splats.ksplat import read_ksplat
from export.importers.splats.ply import read_ply
from export.importers.splats.sog import META, ZIP_PROBLEMS, read_sog
from export.importers.splats.splat import read_splat
from export.importers.splats.spz import read_spz
from msdgs_serve.scene.errors import InvalidInput

READERS: dict[str, Callable[[Path], Splats]] = {
    "ply": read_ply,
    "spz": read_spz,
    "spz:unturned": partial(read_spz, turned=False),
    "sog": read_sog,
    "splat": read_splat,
    "ksplat": read_ksplat,
}
"""Of one set of Gaussians, by the name of the format."""

KINDS_OF_RUNS = ("deformgs", "4dgs")
KINDS = ("model", *READERS, "sequence", "sequence:blend", "sequence:switch", *KINDS_OF_RUNS)
"""All that can be imported: our own model.pt, one set of Gaussians, a folder of them, and runs of other trainers."""

FRAMES = (".ply", ".sog", ".spz", ".splat", ".ksplat")


def recognise(path: Path) -> str:
    """The kind of `path`, one of `KINDS`. Raises `ImportFailed` saying what can be read where it is none."""
    if not path.exists():
        raise ImportFailed(path, "no such file or folder")
    try:
        kind = _folder(path) if path.is_dir() else _file(path)
    except OSError as error:
        raise ImportFailed(path, f"can't be read: {error.strerror or error}") from error
    if kind is None and path.suffix.lower() == ".onnx":
        raise ImportFailed(path, "is a scene file already; export/convert.py writes it as other formats")
    if kind is None:
        raise ImportFailed(path, f"isn't recognised; --from says what it is, one of {', '.join(KINDS)}")
    return kind


def checked_kind(text: str) -> str:
    """One of `KINDS`. Raises `InvalidInput` for anything else."""
    if text not in KINDS:
        raise InvalidInput("--from", f"one of {', '.join(KINDS)}", repr(text))
    return text


def read_splats(path: Path, kind: str | None = None) -> Splats:
    """One set of Gaussians, of a file in any of the formats or of the one named. Raises `ImportFailed`."""
    kind = kind or recognise(path)
    if kind not in READERS:
        raise ImportFailed(path, f"is a {kind}, not one set of Gaussians")
    try:
        return READERS[kind](path)
    except OSError as error:
        raise ImportFailed(path, f"can't be read: {error.strerror or error}") from error


def frame_files(folder: Path) -> list[Path]:
    """The splat files of a folder in the order of the number in which alone their names differ.

    Raises `ImportFailed` naming two that differ in anything else: they are scenes of their own, not frames of one.
    """
    if not folder.is_dir():
        raise ImportFailed(folder, "isn't a folder of frames")
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in FRAMES and not f.name.startswith("."))
    if len(files) < 2:
        return files
    names = [_name_and_numbers(file) for file in files]
    place = max((i for i in range(1, min(map(len, names[:2])), 2) if names[0][i] != names[1][i]), default=0)
    for file, name in zip(files[1:], names[1:], strict=True):
        if not place or name[:place] + name[place + 1 :] != names[0][:place] + names[0][place + 1 :]:
            problem = f"{files[0].name} and {file.name} differ in more than a number"
            raise ImportFailed(folder, f"its splat files aren't frames of one sequence: {problem}")
    return sorted(files, key=lambda file: (int(_name_and_numbers(file)[place]), file.name))


def _name_and_numbers(file: Path) -> list[str]:
    """What is between numbers at even places, numbers at odd ones, the ending last."""
    parts = re.split(r"([0-9]+)", file.stem)
    return [*parts[:-1], f"{parts[-1]}{file.suffix.lower()}"]


def _file(path: Path) -> str | None:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"ply"):
        return "ply"
    if start.startswith((b"NGSP", b"\x1f\x8b")):
        return "spz"
    if path.name == META:
        return "sog"
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                return "sog" if any(name.rsplit("/", 1)[-1] == META for name in archive.namelist()) else "model"
    except ZIP_PROBLEMS as error:
        raise ImportFailed(path, f"isn't a whole zip: {error}") from error
    if path.suffix.lower() in (".splat", ".ksplat", ".sog", ".spz"):
        return path.suffix.lower()[1:]
    return "model" if path.suffix.lower() in (".pt", ".pth") else None


def _folder(path: Path) -> str | None:
    if (path / META).is_file():
        return "sog"
    if (path / "model.pt").is_file():
        return "model"
    if next(path.glob("point_cloud/iteration_*/deformation.pth"), None):
        return "4dgs"
    if next(path.glob("deform/iteration_*/deform.pth"), None):
        return "deformgs"
    if len(frame_files(path)) > 1:
        return "sequence"
    return None
