"""Which format a file or folder is, by what is in it; names decide only where contents can't."""

import re
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from export.importers.errors import ImportFailed
from export.importers.ksplat import read_ksplat
from export.importers.ply import read_ply
from export.importers.sog import META, read_sog
from export.importers.splat import read_splat
from export.importers.splats import Splats
from export.importers.spz import read_spz
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
    kind = _folder(path) if path.is_dir() else _file(path)
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
    """The numbered files of a sequence in the order of their numbers: those of the ending that most of them have."""
    by_ending: dict[str, list[Path]] = {}
    for file in folder.iterdir():
        if file.suffix.lower() in FRAMES and re.search(r"[0-9]+\D*$", file.stem) and not file.name.startswith("."):
            by_ending.setdefault(file.suffix.lower(), []).append(file)
    files = max(by_ending.values(), key=len, default=[])
    return sorted(files, key=lambda file: (int(re.findall(r"[0-9]+", file.stem)[-1]), file.name))


def _file(path: Path) -> str | None:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"ply"):
        return "ply"
    if start.startswith((b"NGSP", b"\x1f\x8b")):
        return "spz"
    if path.name == META:
        return "sog"
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            return "sog" if any(name.rsplit("/", 1)[-1] == META for name in archive.namelist()) else "model"
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
