"""Frames to a film, through PyAV. Needs it: `pip install 'msdgs[video]'`."""

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, BinaryIO, Literal, cast

import numpy as np

from msdgs_serve.scene import InvalidInput, MsdgsError

if TYPE_CHECKING:
    from av.video.stream import VideoStream

VideoFormat = Literal["mp4", "webm", "webp"]


@dataclass(frozen=True)
class VideoTraits:
    """How a format is written."""

    media_type: str
    codec: str
    options: dict[str, str]


VIDEO_FORMATS: dict[VideoFormat, VideoTraits] = {
    "mp4": VideoTraits("video/mp4", "libx264", {"crf": "18", "preset": "fast"}),
    "webm": VideoTraits("video/webm", "libvpx-vp9", {"crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "6"}),
    "webp": VideoTraits("image/webp", "libwebp_anim", {"quality": "70"}),
}

# mp4 in fragments, so that it can be played while it is received; an animated WebP repeats without end
MUXER_OPTIONS: dict[VideoFormat, dict[str, str]] = {
    "mp4": {"movflags": "frag_keyframe+empty_moov+default_base_moof"},
    "webm": {},
    "webp": {"loop": "0"},
}


class VideoUnavailable(MsdgsError):
    """PyAV is not installed."""


def check_video(video_format: str) -> None:
    """Raise `InvalidInput` for a format that isn't known, and `VideoUnavailable` where films can't be written."""
    if video_format not in VIDEO_FORMATS:
        raise InvalidInput("format", f"one of {', '.join(VIDEO_FORMATS)}", video_format)
    try:
        import av  # noqa: F401  # an extra; nothing else here needs it
    except ImportError:
        raise VideoUnavailable("films need PyAV: pip install 'msdgs[video]'") from None


def write_video(frames: Iterable[np.ndarray], fps: float, video_format: VideoFormat, file: BinaryIO) -> int:
    """Write sRGB frames, [H, W, 3] uint8 of one size, to a seekable file; returns how many there were.

    An odd row or column at the lower or right edge is left out: the codecs want even sizes.
    """
    import av

    traits = VIDEO_FORMATS[video_format]
    count = 0
    with av.open(file, "w", format=video_format, options=MUXER_OPTIONS[video_format]) as container:
        stream = None
        for pixels in frames:
            height, width = (side - side % 2 for side in pixels.shape[:2])
            if stream is None:
                if min(height, width) < 2:
                    raise InvalidInput("height" if height < width else "width", "at least 2 for a film", pixels.shape)
                rate = Fraction(fps).limit_denominator(1001)
                stream = cast(
                    "VideoStream", container.add_stream(traits.codec, rate=rate, options=dict(traits.options))
                )
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels[:height, :width]), format="rgb24")
            container.mux(stream.encode(frame))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count
