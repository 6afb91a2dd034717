"""The images of a folder as frames of one camera, upright as their EXIF orientation says, and in sRGB."""

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.pictures import Picture, fitted
from msdgs_train.datasets.common.images import TURNED, ImageHeader, composite, read_header, read_rgba
from msdgs_train.datasets.common.name_fields import Number, natural_order
from msdgs_train.datasets.common.name_times import NameWithoutTime, readings
from msdgs_train.datasets.common.readers import DatasetInvalid

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".avif", ".dng")
"""Of files that are meant as images, of which those that can't be read are refused."""
UNREAD = {".heic", ".heif", ".avif", ".dng"}
"""Of them, those that need a decoder that OpenImageIO's packages don't have."""
VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".3gp", ".gif")
RATE = 30
"""Images per second, as folders of images say nothing of it."""

ORIENTATIONS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda pixels: pixels[:, ::-1],
    3: lambda pixels: pixels[::-1, ::-1],
    4: lambda pixels: pixels[::-1],
    5: lambda pixels: pixels.swapaxes(0, 1),
    6: lambda pixels: pixels.swapaxes(0, 1)[:, ::-1],
    7: lambda pixels: pixels.swapaxes(0, 1)[::-1, ::-1],
    8: lambda pixels: pixels.swapaxes(0, 1)[::-1],
}
"""From stored to shown pixels [H, W, …], by EXIF's number; others are shown as they are stored."""


class ImageSource:
    """A folder of images as `Source`, in the order of the times in their names, or else of the names; raises
    `CaptureFailed`."""

    def __init__(self, folder: Path, size: int) -> None:
        self.file = folder
        files = image_files(folder)
        clock = _clock([file.name for file in files])
        times = [Fraction(index, RATE) for index in range(len(files))] if clock is None else clock.times
        order = sorted(range(len(files)), key=lambda index: times[index])
        self._files = [files[index] for index in order]
        self._times = [float(times[index] - times[order[0]]) for index in order]
        self._is_timed = clock is not None and clock.is_true
        self.count, self.duration = len(files), self._times[-1]
        self.period = self.duration / (self.count - 1) if self._is_timed and self.count > 1 else 1 / RATE
        first, *others = ((file, _shown_size(file)) for file in self._files)
        for file, shown in others:
            if shown != first[1]:
                (width, height), (width0, height0) = shown, first[1]
                raise CaptureFailed(
                    file, f"is {width}×{height}, but {first[0].name} is {width0}×{height0}: give images of one size"
                )
        self.width, self.height = fitted(*first[1], size)

    def pictures(self) -> Iterator[Picture]:
        """Read each image once."""
        import cv2

        for index, (file, time) in enumerate(zip(self._files, self._times, strict=True)):
            pixels = read_image(file)
            if pixels.shape[:2] != (self.height, self.width):
                pixels = cv2.resize(pixels, (self.width, self.height), interpolation=cv2.INTER_AREA)
            yield Picture(index, time, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), lambda shown=pixels: shown)

    def notes(self) -> list[str]:
        if self._is_timed:
            return []
        return [f"{self.file.name} is a folder of images, which has no times: {RATE} images per second are assumed"]


def image_files(folder: Path) -> list[Path]:
    """The images in a folder in the natural order of their names. Raises `CaptureFailed` if there are none."""
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    images = [file for file in files if file.suffix.lower() in ENDINGS]
    if images:
        return sorted(images, key=lambda file: natural_order(file.name))
    if videos := [file.name for file in files if file.suffix.lower() in VIDEO_ENDINGS]:
        raise CaptureFailed(folder, f"has no images, but videos such as {videos[0]}: give the videos themselves")
    if below := sorted(each.name for each in folder.iterdir() if each.is_dir()):
        raise CaptureFailed(folder, f"has no images, but folders such as {below[0]}: give a folder for each camera")
    raise CaptureFailed(folder, f"has no images in it, whose names would end with {', '.join(ENDINGS)}")


def read_image(file: Path) -> np.ndarray:
    """Read uint8 sRGB [H, W, 3], upright, transparent parts black. Raises `CaptureFailed`."""
    try:
        rgba = read_rgba(file)
    except DatasetInvalid as error:
        raise _unreadable(file, error.problem) from None
    if (rgba[..., 3] < 255).any():
        rgba[..., :3] = (255 * composite(rgba, (0.0, 0.0, 0.0)) + 0.5).astype(np.uint8)
    shown = ORIENTATIONS.get(_header(file).orientation, lambda pixels: pixels)(rgba[..., :3])
    return np.ascontiguousarray(shown)


@cache
def _header(file: Path) -> ImageHeader:
    try:
        return read_header(file)
    except DatasetInvalid as error:
        raise _unreadable(file, error.problem) from None


def _unreadable(file: Path, problem: str) -> CaptureFailed:
    if file.suffix.lower() in UNREAD:
        kind = file.suffix[1:].upper()
        return CaptureFailed(
            file, f"is {kind}, which isn't read: convert all images to JPEG or PNG, of their full size"
        )
    return CaptureFailed(file, problem)


def _shown_size(file: Path) -> tuple[int, int]:
    (width, height), orientation = _header(file)
    return (height, width) if orientation in TURNED else (width, height)


def starts_by_names(folders: Sequence[Path]) -> tuple[float, ...] | None:
    """Seconds by which each folder begins after the first one, if the names of all have times of one kind in common."""
    if not all(folder.is_dir() for folder in folders):
        return None
    clocks = [_clock([file.name for file in image_files(folder)]) for folder in folders]
    known = [clock for clock in clocks if clock is not None]
    firsts, lasts = [min(clock.times) for clock in known], [max(clock.times) for clock in known]
    if len(known) < len(clocks) or len({clock.is_true for clock in known}) > 1 or max(firsts) > min(lasts):
        return None
    return tuple(float(first - firsts[0]) for first in firsts)


class _Clock(NamedTuple):
    """The times in the names of images."""

    times: tuple[Number, ...]  # seconds, all different
    is_true: bool  # or of frames, at `RATE`


def _clock(names: list[str]) -> _Clock | None:
    """The only times that names may have; None if there are none."""
    try:
        found = readings(names, range(len(names)), [None] * len(names))
    except NameWithoutTime:
        return None
    if len(found) != 1 or found[0].called is not None or len(set(found[0].times)) < len(names):
        return None
    times, is_true = found[0].times, found[0].is_in_seconds
    return _Clock(times if is_true else tuple(Fraction(time) / RATE for time in times), is_true)
