"""The recordings of a capture and the folder that it fills: what they are, and that neither is mistaken for another."""

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from msdgs_serve import __version__
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import write_text
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.pictures import Source

WORK = "capture"
"""Folder of the steps' results in the dataset's folder."""
CLAIM = "recordings.json"
"""File in `WORK` that tells whose capture the folder is."""
BYTES_PER_PIXEL = 4.0
"""Frames and images of the dataset as PNG, of 1.5 to 2 bytes a pixel each, and masks."""
BYTES_PER_FRAME = 4_000_000
"""Two of COLMAP's databases: descriptors of 8,192 features, and matches."""


def digest_of(recordings: Sequence[Path]) -> str:
    """A digest of the contents of video files and of folders of images, of their order, and of the names of images,
    which may tell times; not of other names.

    Raises `CaptureFailed` if two of them are the same.
    """
    known: dict[str, Path] = {}
    for recording in recordings:
        digest = _digest(recording)
        if digest in known:
            raise CaptureFailed(recording, f"is the same recording as {known[digest]}: give each camera's once")
        known[digest] = recording
    images = [file.name for recording in recordings if recording.is_dir() for file in _files(recording)]
    return hashlib.sha256("\n".join([__version__, *known, *images]).encode()).hexdigest()


def _files(recording: Path) -> list[Path]:
    return sorted(file for file in recording.iterdir() if file.is_file()) if recording.is_dir() else [recording]


def _digest(recording: Path) -> str:
    files = _files(recording)
    digest = hashlib.sha256(f"{len(files)}\n".encode())
    for file in files:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    return digest.hexdigest()


def claim(data: Path, digest: str) -> None:
    """Make the folder of a capture. Raises `InvalidInput` if it holds anything but a capture of the same recordings."""
    mark = data / WORK / CLAIM
    if data.exists() and not data.is_dir():
        raise InvalidInput("DATA", "a folder, new or empty, after the recordings", data)
    if mark.is_file():
        if json.loads(mark.read_text(encoding="utf-8"))["digest"] == digest:
            return
        if any(file.name != CLAIM for file in mark.parent.iterdir()):
            other = "it holds that of other recordings, or of another version of msdgs"
            raise InvalidInput("DATA", "a new folder, or that of an earlier capture of the same", f"{data}: {other}")
    elif data.is_dir() and any(data.iterdir()):
        raise InvalidInput("DATA", "a new or empty folder", f"{data}, which holds other files")
    mark.parent.mkdir(parents=True, exist_ok=True)
    write_text(mark, json.dumps({"digest": digest}) + "\n")


@contextmanager
def held(data: Path) -> Iterator[None]:
    """Keep other processes from capturing into a folder. Raises `InvalidInput` if one does already."""
    folder = os.open(data / WORK, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InvalidInput("DATA", "a folder into which no other process captures", data) from None
        yield
    finally:
        os.close(folder)


def required_bytes(sources: Sequence[Source], frames: int) -> int:
    """Bytes of disk that a capture takes at most while it runs, about."""
    of_frames = [each.width * each.height * BYTES_PER_PIXEL + BYTES_PER_FRAME for each in sources]
    return round(sum(min(frames, each.count) * of_frame for each, of_frame in zip(sources, of_frames, strict=True)))


def require_disk(data: Path, needed: int) -> None:
    """Raise `CaptureFailed` if the disk of a folder has less than `needed` bytes to spare, beside what it holds."""
    held = sum(file.stat().st_size for file in data.rglob("*") if file.is_file())
    free = shutil.disk_usage(data).free
    if free + held < needed:
        problem = f"needs up to {gigabytes(needed)} on a disk that has {gigabytes(free)} free"
        raise CaptureFailed(data, f"{problem}; free space, choose another disk, or give smaller --frames or --size")


def gigabytes(count: int) -> str:
    """A number of bytes in words."""
    return f"{count / 1e9:.1f} GB"
