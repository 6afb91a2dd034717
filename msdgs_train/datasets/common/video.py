"""Videos as training images: one file per camera, whose frames are read in random order.

H.264 has no random access: a frame is decoded from the keyframe before it, 0.8 s for the 20th frame at 2704×2028 on two
busy cores, against milliseconds from stored pixels. Therefore the first access to a frame decodes the whole video,
frame by frame and downscaled to the training size, into one uint8 `.npy` file [F, H, W, 3], which is memory-mapped from
then on and reused by later runs. At most one frame is held as an array at a time.

Frames are turned and mirrored as the video's display matrix says, as every player and FFmpeg do; sizes are those of
the turned frames.

The files are in `$XDG_CACHE_HOME/msdgs/videos`, or else `~/.cache/msdgs/videos`, and may be deleted if no training is
running: 1.2 GB for 300 frames of 1352×1014. Their names depend on the video's path, size and modification time.
"""

import hashlib
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdgs_serve.writing import reason, replacing
from msdgs_train.datasets.common.readers import DatasetInvalid
from msdgs_train.datasets.common.scene_data import Frame
from msdgs_train.datasets.common.video_colors import as_srgb

MAX_TILT = 0.02
"""Sine of the angle, about 1°, up to which a display matrix is taken for one of a right angle, as FFmpeg does."""


class Turn(NamedTuple):
    """What the display matrix does to a frame: rows and columns are exchanged first, then it is mirrored."""

    transposed: bool = False
    mirrored: bool = False  # left to right
    upside_down: bool = False  # top to bottom

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """The frame as it is shown, from [H, W, …] as it is stored."""
        shown = pixels.swapaxes(0, 1) if self.transposed else pixels
        return shown[:: -1 if self.upside_down else 1, :: -1 if self.mirrored else 1]


class VideoInfo(NamedTuple):
    """The header of a video; sizes in pixels, of frames as they are shown."""

    count: int
    width: int
    height: int
    turn: Turn = Turn()


@dataclass(frozen=True, kw_only=True)
class VideoFrame(Frame):
    """A frame of a video. `image_path` isn't a file: it is the video's path followed by the frame's number."""

    video: Path
    index: int
    info: VideoInfo  # of the video

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.video,)

    def load_rgba(self) -> np.ndarray:
        """Read [height, width, 4] uint8, sRGB, opaque, of the camera's size. The first call decodes the video."""
        width, height = self.camera.width, self.camera.height
        frames = open_frames(self.video, self.info._replace(width=width, height=height))
        rgba = np.full((height, width, 4), 255, np.uint8)
        rgba[..., :3] = frames[self.index]
        return rgba


def read_info(video: Path) -> VideoInfo:
    """Read the count, size and display matrix of the frames, of which only the first is decoded. Raises
    `DatasetInvalid` naming the file."""
    with opened_video(video) as container:
        if not container.streams.video:
            raise _invalid(video, "has no video stream")
        stream = container.streams.video[0]
        width, height = stream.codec_context.width, stream.codec_context.height
        first = next(container.decode(stream), None)
        if first is None:
            raise _invalid(video, "has no frames")
        turn = display_turn(video, first)
        count = stream.frames - sum(entry.is_discard for entry in stream.index_entries)  # by cuts without encoding
    if not count:
        with opened_video(video) as container:
            count = sum(packet.size > 0 for packet in container.demux(container.streams.video[0]))
    return VideoInfo(count, *((height, width) if turn.transposed else (width, height)), turn)


def display_turn(video: Path, frame: Any) -> Turn:
    """The turn by the matrix (a b, c d) of PyAV's frame, which sends column x, row y to (a x + c y, b x + d y).

    Raises `DatasetInvalid` for one that isn't by multiples of 90°.
    """
    display_matrix = frame.side_data.get("DISPLAYMATRIX")
    if display_matrix is None or not any(np.frombuffer(bytes(display_matrix), np.int32)[:5]):
        return Turn()
    a, b, _, c, d = np.frombuffer(bytes(display_matrix), np.int32)[:5].tolist()
    straight, across = min(abs(a), abs(d)), min(abs(b), abs(c))
    if max(abs(b), abs(c)) < MAX_TILT * straight:
        return Turn(False, a < 0, d < 0)
    if max(abs(a), abs(d)) < MAX_TILT * across:
        return Turn(True, c < 0, b < 0)
    degrees = math.degrees(math.atan2(b, a))
    raise _invalid(
        video, f"is shown turned by {degrees:.1f}°, but must be by multiples of 90°: encode it again, turned so"
    )


def open_frames(video: Path, wanted: VideoInfo) -> np.ndarray:
    """Return [count, height, width, 3] uint8 RGB, read-only and memory-mapped, downscaled to the wanted size.

    Decodes the video unless it is cached. Raises `DatasetInvalid` if it has another number of frames, can't be decoded,
    or its frames can't be stored.
    """
    cached = _cache_file(video, wanted)
    try:
        frames = np.load(cached, mmap_mode="r", allow_pickle=False)
        if frames.shape == (wanted.count, wanted.height, wanted.width, 3) and frames.dtype == np.uint8:
            return frames
    except (OSError, ValueError, EOFError):  # missing or truncated
        pass
    _decode_to(cached, video, wanted)
    return np.load(cached, mmap_mode="r", allow_pickle=False)


def _cache_file(video: Path, wanted: VideoInfo) -> Path:
    try:
        state = video.stat()
    except OSError as error:
        raise _invalid(video, f"can't be read: {error.strerror}") from None
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    identity = f"{video.resolve()} {state.st_size} {state.st_mtime_ns} {wanted}"
    return root / "msdgs" / "videos" / f"{video.stem}-{hashlib.sha256(identity.encode()).hexdigest()[:20]}.npy"


def _decode_to(file: Path, video: Path, wanted: VideoInfo) -> None:
    """Write the frames as a stream: on a full disk this raises an error, but a memory map would kill the process."""
    count, shape = 0, (wanted.count, wanted.height, wanted.width, 3)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary, temporary.open("wb") as output:
            np.lib.format.write_array_header_1_0(output, {"descr": "|u1", "fortran_order": False, "shape": shape})
            for pixels in _decoded(video, wanted):
                count += 1
                if count <= wanted.count:
                    output.write(pixels.data)
            if count != wanted.count:
                problem = f"has {wanted.count} frames by its header, but {count} can be decoded: encode it again"
                raise _invalid(video, problem)
    except OSError as error:
        gigabytes = 3e-9 * wanted.count * wanted.width * wanted.height
        problem = f"can't be decoded into {file.parent}: {reason(error)}. It takes {gigabytes:.1f} GB. Set the "
        problem += "environment variable XDG_CACHE_HOME to a folder with space, or train at a smaller size"
        raise _invalid(video, problem) from None


def _decoded(video: Path, wanted: VideoInfo) -> Iterator[np.ndarray]:
    """Yield the frames as contiguous uint8 sRGB [height, width, 3]."""
    turn = wanted.turn
    width, height = (wanted.height, wanted.width) if turn.transposed else (wanted.width, wanted.height)
    with opened_video(video) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        for frame in container.decode(stream):
            yield np.ascontiguousarray(turn(as_srgb(frame, width, height)))


@contextmanager
def opened_video(video: Path) -> Iterator[Any]:
    """The container of the video, in PyAV. Its errors in the block are raised as `DatasetInvalid`.

    The prefix `file:` has FFmpeg take no part of a name such as `12:30.mp4` for a protocol.
    """
    try:
        import av  # an optional dependency
        from av.error import FFmpegError
    except ModuleNotFoundError as error:
        raise _invalid(video, f"needs {error.name} to be read: pip install 'msdgs[train]'") from None
    try:
        with av.open(f"file:{video}") as container:
            yield container
    except FFmpegError as error:
        raise _invalid(video, f"can't be read: {error.strerror}") from None


def _invalid(video: Path, problem: str) -> DatasetInvalid:
    return DatasetInvalid(video, "video", problem)
