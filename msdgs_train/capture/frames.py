"""Frames with their true times, from videos or folders of images, as PNG files without metadata."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdgs_serve.scene import InvalidInput
from msdgs_serve.writing import writing
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.frame_set import CapturedCamera, CapturedFrame, FrameSet
from msdgs_train.capture.image_source import ImageSource, starts_by_names
from msdgs_train.capture.pictures import Picture, Source
from msdgs_train.capture.selection import Intervals, Moments, Selection, blurred, cuts, select
from msdgs_train.capture.video_source import VideoSource

DIGITS = 5
"""Of a frame's number in its name, at least."""
MIN_SIZE = 64
"""Pixels of the longer side; smaller pictures have next to no features."""


def extract_frames(
    inputs: Sequence[Path],
    folder: Path,
    *,
    frames: int = 300,
    size: int = 1024,
    offsets: Sequence[float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FrameSet:
    """Write frames of each video, or folder of images, into `folder`, named by their number in the video.

    `frames` is the number that is wanted over the longest video; a video with fewer gives all. `size` is the long side
    in pixels, which nothing is enlarged to. `offsets` are the seconds by which the videos start after the first one; if
    None, folders of images start as their names say, others together. Of the first video the sharpest frame of each
    interval is taken, of the others those nearest in time to them. `progress` is called with the numbers of frames that
    are read and of all.

    Each video is decoded once, with two of its frames in memory. Raises `CaptureFailed`, `InvalidInput` and
    `WriteFailed`.
    """
    check_amounts(frames, size)
    sources = [open_source(file, size) for file in inputs]
    offsets = starts_by_names(inputs) if offsets is None else offsets
    return take_frames(sources, folder, frames=frames, offsets=offsets, progress=progress)


def take_frames(
    sources: Sequence[Source],
    folder: Path,
    *,
    frames: int,
    offsets: Sequence[float] | None,
    progress: Callable[[int, int], None] | None,
) -> FrameSet:
    """`extract_frames` of sources that are open."""
    offsets = starts(sources, offsets)
    _require_common_moments(sources, offsets)
    step = max(source.duration + source.period for source in sources) / frames
    ticker = _Ticker(sum(source.count for source in sources), progress)
    selections: list[Selection] = []
    for index, (source, start) in enumerate(zip(sources, offsets, strict=True)):
        moments = _moments(source, start, frames, step, selections[0] if selections else None)
        digits = max(DIGITS, len(str(source.count)))
        name = f"{camera_name(index, len(sources))}/" if len(sources) > 1 else ""
        writer = _Writer(folder, f"{name}{{:0{digits}}}.png")
        selections.append(select(source.pictures(), start, moments, writer, ticker))
        if not selections[-1].taken:
            raise CaptureFailed(source.file, _nothing(selections[-1]))
    return _frame_set(sources, offsets, selections, folder)


def check_amounts(frames: int, size: int) -> None:
    """Raise `InvalidInput` for numbers of frames, and of pixels of the longer side, that no capture can have."""
    for name, value, least in (("frames", frames, 1), ("size", size, MIN_SIZE)):
        if not least <= value < 2**31:
            raise InvalidInput(name, f"{least} or more, below 2³¹", value)


def open_source(file: Path, size: int) -> Source:
    """The pictures of a video or of a folder of images. Raises `CaptureFailed`."""
    if not file.exists():
        raise CaptureFailed(file, "does not exist: give a video, or a folder of images")
    return ImageSource(file, size) if file.is_dir() else VideoSource(file, size)


def camera_name(index: int, count: int) -> str:
    """The folder of a camera's frames, counted from 1; empty for the only one."""
    return "" if count == 1 else f"cam{index + 1:0{max(2, len(str(count)))}}"


def starts(inputs: Sequence[Path | Source], offsets: Sequence[float] | None) -> list[float]:
    """Seconds on the clock of the first camera at which each starts, 0 if `offsets` is None. Raises `InvalidInput`."""
    if not inputs:
        raise InvalidInput("inputs", "one video or more", "none")
    if offsets is None:
        return [0.0] * len(inputs)
    if len(offsets) != len(inputs) or not np.isfinite(offsets).all():
        raise InvalidInput("offsets", f"one finite number for each recording, {len(inputs)}", list(offsets))
    return [offset - offsets[0] for offset in offsets]


def _require_common_moments(sources: Sequence[Source], starts: Sequence[float]) -> None:
    """Raise `InvalidInput` if a recording shows no moment that another one shows."""
    spans = [(start, start + source.duration) for source, start in zip(sources, starts, strict=True)]
    for index, (first, last) in enumerate(spans):
        others = spans[:index] + spans[index + 1 :]
        if others and all(last < start or first > end for start, end in others):
            expected = "seconds by which recordings begin after the first one, but no other one shows a moment of "
            raise InvalidInput("offsets", f"{expected}recording {index + 1}", list(starts))


def _moments(source: Source, start: float, frames: int, step: float, first: Selection | None) -> Intervals | Moments:
    if source.count <= frames:
        return Intervals(start, 0)
    if first is None:
        return Intervals(start, step)
    return Moments([each.time for each in first.taken], step, start, start + source.duration)


def _nothing(selection: Selection) -> str:
    if selection.black:
        return "is black, or of one color, in all of its frames: record it again"
    return "holds no frame that can be decoded: record or copy it again"


def _frame_set(
    sources: Sequence[Source], starts: Sequence[float], selections: Sequence[Selection], folder: Path
) -> FrameSet:
    """What was taken, without those that are blurred, whose files are removed."""
    cameras, frames, without = [], [], 0
    for index, (source, start, selection) in enumerate(zip(sources, starts, selections, strict=True)):
        name = camera_name(index, len(sources))
        cameras.append(CapturedCamera(name, source.width, source.height, source.duration, source.count, start))
        left_out = {each.name for each in blurred(selection.taken)}
        for unwanted in left_out:
            (folder / unwanted).unlink()
        without += len(left_out)
        kept = [each for each in selection.taken if each.name not in left_out]
        frames += [CapturedFrame(each.name, index, each.time, each.sharpness) for each in kept]
    return FrameSet(
        tuple(cameras),
        tuple(frames),
        blurred=without,
        cuts=tuple(sorted(time for selection in selections for time in cuts(selection.changes))),
        black=sum(selection.black for selection in selections),
        repeated=sum(selection.repeated for selection in selections),
        notes=tuple(note for source in sources for note in source.notes()),
    )


@dataclass
class _Writer:
    """Writes pictures as PNG files."""

    folder: Path
    name: str  # with a place for the number

    def __call__(self, picture: Picture) -> str:
        import cv2

        name = self.name.format(picture.index)
        file = self.folder / name
        with writing(file):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(cv2.imencode(".png", picture.srgb()[..., ::-1])[1].tobytes())
        return name


@dataclass
class _Ticker:
    total: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def __call__(self) -> None:
        self.done += 1
        if self.progress is not None:
            self.progress(min(self.done, self.total), self.total)
