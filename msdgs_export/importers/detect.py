"""Detection of the format of a file or folder by its contents, or by its name if the contents don't tell."""

import re
import zipfile
from itertools import pairwise
from pathlib import Path

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.model import RUNS, run_format
from msdgs_export.importers.splats.formats import READERS, refuse_pointer, splat_format
from msdgs_serve.scene.errors import InvalidInput

FORMATS = ("model", *READERS, "sequence", "sequence:blend", "sequence:switch", *RUNS)
"""All inputs: our own model.pt, one set of Gaussians, a folder of them, and runs of other trainers."""

TRAINED = ("model", *RUNS)
"""Inputs with a trained model, which is pruned and fitted."""

FRAMES = (".ply", ".sog", ".spz", ".splat", ".ksplat", ".ply.gz")


def input_format(path: Path, asked: str) -> str:
    """The format of `path`, one of `FORMATS`: the one asked for, or with `detect` what its contents are.

    Raises `InvalidInput` for another format, and `ImportFailed`.
    """
    if path.is_file():
        refuse_pointer(path)
    if asked not in ("detect", *FORMATS):
        raise InvalidInput("format", f"detect or one of {', '.join(FORMATS)}", repr(asked))
    if asked != "detect":
        return asked
    return "model" if not path.exists() or path.suffix == ".pt" else detect_format(path)


def detect_format(path: Path) -> str:
    """The format of `path`, one of `FORMATS`. Raises `ImportFailed` listing the formats if it is none."""
    if not path.exists():
        raise ImportFailed(path, "no such file or folder")
    try:
        found = splat_format(path) or (_folder(path) if path.is_dir() else _model(path))
    except OSError as error:
        raise ImportFailed(path, f"can't be read: {error.strerror or error}") from error
    if found is None and path.suffix.lower() == ".onnx":
        raise ImportFailed(path, "is a scene file already; msdgs-convert writes it as other formats")
    if found is None:
        raise ImportFailed(
            path, _instead(path) or f"has no known format; --format names it, one of {', '.join(FORMATS)}"
        )
    return found


def frame_files(folder: Path) -> dict[Path, float]:
    """The splat files of a folder and the number in their names, which may have decimals, in its order.

    Raises `ImportFailed` naming two whose names differ in anything else: they are separate scenes, not frames; also two
    of the same number, and of numbers with more and with fewer decimals, as in 0.9 and 0.10.
    """
    if not folder.is_dir():
        raise ImportFailed(folder, "isn't a folder of frames")
    files = sorted(f for f in folder.iterdir() if f.name.lower().endswith(FRAMES) and not f.name.startswith("."))
    if len(files) < 2:
        return dict.fromkeys(files, 0.0)
    names = [_name_and_numbers(file) for file in files]
    place = max((i for i in range(1, min(map(len, names[:2])), 2) if names[0][i] != names[1][i]), default=0)
    for file, name in zip(files[1:], names[1:], strict=True):
        if not place or name[:place] + name[place + 1 :] != names[0][:place] + names[0][place + 1 :]:
            problem = f"{files[0].name} and {file.name} differ in more than a number"
            raise ImportFailed(folder, f"its splat files aren't frames of one sequence: {problem}")
    texts = {file: name[place] for file, name in zip(files, names, strict=True)}
    numbers = {file: float(texts[file]) for file in sorted(files, key=lambda file: float(texts[file]))}
    for one, other in pairwise(numbers):
        if numbers[one] == numbers[other]:
            raise ImportFailed(
                folder, f"{one.name} and {other.name} have the same number: its files aren't one sequence"
            )
        if len(texts[one].partition(".")[2]) != len(texts[other].partition(".")[2]):
            problem = f"{texts[one]} and {texts[other]} may be decimals or count behind the point"
            raise ImportFailed(folder, f"its frames have no clear order: {problem}; name them with as many digits each")
    return numbers


def _instead(path: Path) -> str | None:
    """What to give instead of something that other programs write."""
    if clouds := sorted(path.glob("point_cloud/iteration_*/point_cloud.ply"), key=lambda file: file.stat().st_mtime):
        return f"is the folder of a training; {clouds[-1].relative_to(path)} in it can be read"
    if path.suffix.lower() in (".glb", ".gltf"):
        return "is glTF, which is written but not read; give the file that it was made of"
    configs = [path] if path.name == "config.yml" else [*path.glob("config.yml"), *path.glob("*/*/config.yml")]
    if configs:
        return f"is of nerfstudio: ns-export gaussian-splat --load-config {configs[-1]} writes a PLY, which can be read"
    return None


def _name_and_numbers(file: Path) -> list[str]:
    """The name split into text at even indices and numbers at odd ones; the last text includes the suffix."""
    parts = re.split(r"([0-9]+(?:\.[0-9]+)?)", file.stem)
    return [*parts[:-1], f"{parts[-1]}{file.suffix.lower()}"]


def _model(path: Path) -> str | None:
    if path.suffix.lower() in (".pt", ".pth"):
        return "model"
    if not zipfile.is_zipfile(path):
        return None
    with zipfile.ZipFile(path) as archive:
        return "model" if any(name.endswith("/data.pkl") for name in archive.namelist()) else None


def _folder(path: Path) -> str | None:
    if (path / "model.pt").is_file():
        return "model"
    return run_format(path) or ("sequence" if len(frame_files(path)) > 1 else None)
