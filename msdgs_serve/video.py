"""Encode frames as a video with PyAV. Needs `pip install 'msdgs[video]'`."""

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, BinaryIO, Literal, cast

import numpy as np

from msdgs_serve.camera_path import check_fps
from msdgs_serve.scene import InvalidInput, MsdgsError
from msdgs_serve.scene.camera import MAX_PIXELS_PER_SIDE

if TYPE_CHECKING:
    from av.video.stream import VideoStream

VideoFormat = Literal["mp4", "webm", "webp"]
PIXELS = "yuv420p"


@dataclass(frozen=True)
class VideoTraits:
    """Media type, encoder and limits of a video format."""

    media_type: str
    codec: str
    options: dict[str, str]
    names_colorspace: bool = True  # BT.709, which players assume; WebP is always BT.601
    max_side: int = MAX_PIXELS_PER_SIDE
    pixels_of_odd_sizes: str = PIXELS


# Lookahead and threads of an encoder keep frames in memory: 330 to 390 MB at 1920 × 1080 with x264's defaults, 190 MB
# with these, for files of the same size.
BOUNDED = {"threads": "4"}
VIDEO_FORMATS: dict[VideoFormat, VideoTraits] = {
    "mp4": VideoTraits(
        "video/mp4", "libx264",
        {"crf": "18", "preset": "fast", "rc-lookahead": "10", **BOUNDED},
        pixels_of_odd_sizes="yuv444p",  # H.264 has no odd sizes in 4:2:0
    ),
    "webm": VideoTraits(
        "video/webm", "libvpx-vp9",
        {"crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "6", "lag-in-frames": "0", **BOUNDED},
    ),
    "webp": VideoTraits("image/webp", "libwebp_anim", {"quality": "70"}, names_colorspace=False, max_side=16383),
}  # fmt: skip

BT709 = 1  # as colorspace, primaries and transfer function alike
LIMITED_RANGE = 1

# fragmented mp4 can be played while it is received; its header waits for the first fragment, by which it knows that the
# times of frames, which x264 reorders, begin at 0, so a fragment is a second; animated WebP loops forever
MUXER_OPTIONS: dict[VideoFormat, dict[str, str]] = {
    "mp4": {"movflags": "frag_keyframe+delay_moov+default_base_moof", "frag_duration": "1000000"},  # microseconds
    "webm": {"cluster_time_limit": "1000"},  # milliseconds
    "webp": {"loop": "0"},
}


class VideoUnavailable(MsdgsError):
    """PyAV or one of its encoders is not installed."""


def require_pyav(video_format: VideoFormat) -> None:
    """Raise `VideoUnavailable` without PyAV, an optional dependency, or without the format's encoder in it."""
    try:
        import av
    except ImportError:
        raise VideoUnavailable("videos need PyAV: pip install 'msdgs[video]'") from None
    codec = VIDEO_FORMATS[video_format].codec
    if codec not in av.codecs_available:
        raise VideoUnavailable(f"{video_format} needs {codec}, which this build of PyAV lacks, unlike that of PyPI")


def check_size(video_format: VideoFormat, width: int, height: int) -> None:
    """Raise `InvalidInput` for a size that the format doesn't have."""
    most = VIDEO_FORMATS[video_format].max_side
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= most:
            raise InvalidInput(name, f"in [1, {most}] for {video_format}", side)


def pixels_of(video_format: VideoFormat, width: int, height: int) -> str:
    """Return FFmpeg's name for the layout of pixels in a video of this size: `PIXELS`, which every player shows, or
    another."""
    is_odd = width % 2 or height % 2
    return VIDEO_FORMATS[video_format].pixels_of_odd_sizes if is_odd else PIXELS


class VideoWriter:
    """Encodes sRGB frames, [H, W, 3] uint8 of one size, into a file that may not support `seek`.

    Not safe to use from several threads. Raises `InvalidInput` for frames per second or sizes that the format doesn't
    have.
    """

    def __init__(self, file: BinaryIO, fps: float, video_format: VideoFormat) -> None:
        import av

        check_fps(fps)
        self._format: VideoFormat = video_format
        self._traits = VIDEO_FORMATS[video_format]
        self._rate = Fraction(fps).limit_denominator(1001)
        self._container = av.open(file, "w", format=video_format, options=MUXER_OPTIONS[video_format])
        self._stream: VideoStream | None = None

    def add(self, pixels: np.ndarray) -> None:
        """Encode the next frame. The encoder may delay its output."""
        import av

        height, width = pixels.shape[:2]
        if self._stream is None:
            self._stream = self._open_stream(width, height)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        if self._traits.names_colorspace:
            frame = frame.reformat(format=self._stream.pix_fmt, dst_colorspace=BT709)
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the delayed frames and the end of the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def _open_stream(self, width: int, height: int) -> "VideoStream":
        check_size(self._format, width, height)
        options = dict(self._traits.options)
        stream = cast("VideoStream", self._container.add_stream(self._traits.codec, rate=self._rate, options=options))
        stream.width, stream.height, stream.pix_fmt = width, height, pixels_of(self._format, width, height)
        if self._traits.names_colorspace:
            stream.colorspace = stream.color_primaries = stream.color_trc = BT709
            stream.color_range = LIMITED_RANGE
        return stream


def write_video(frames: Iterable[np.ndarray], fps: float, video_format: VideoFormat, file: BinaryIO) -> int:
    """Write frames to a file and return their number. See `VideoWriter`."""
    writer, count = VideoWriter(file, fps, video_format), 0
    for pixels in frames:
        writer.add(pixels)
        count += 1
    writer.close()
    return count
