"""Small videos with known contents and times."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.codec.context import Flags
from av.video.reformatter import Interpolation

from tests.support.clips import REPEATABLE

WIDTH, HEIGHT = 96, 64
ACCURATE = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INP
TICKS = 90_000
"""Of the clock of written videos, per second."""


def picture(index: float, width: int = WIDTH, height: int = HEIGHT, seed: int = 0) -> np.ndarray:
    """[height, width, 3] uint8 of smooth blobs that move by 1.5 pixels a frame; `seed` chooses other ones."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    image = np.full((height, width, 3), 90.0)
    for _ in range(40):
        center = rng.uniform(0, 1, 2) * (1.4 * width, height) - (0.2 * width, 0)
        shape = np.exp(-((x - center[0] - 1.5 * index) ** 2 + (y - center[1]) ** 2) / (2 * rng.uniform(1, 5) ** 2))
        image += shape[..., None] * rng.uniform(-90, 130, 3)
    return image.clip(0, 255).astype(np.uint8)


def pictures(count: int, **options: Any) -> list[np.ndarray]:
    return [picture(index, **options) for index in range(count)]


def write_clip(
    path: Path,
    images: Sequence[np.ndarray],
    *,
    times: Sequence[float] | None = None,
    rate: int = 30,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    options: dict[str, str] | None = None,
    turn: int = 0,
    muxer: dict[str, str] | None = None,
    metadata: dict[str, str] | None = None,
    sound: np.ndarray | None = None,
    interlaced: bool = False,
    colors: dict[str, int] | None = None,
) -> Path:
    """Write a video; `times` in seconds, `turn` in degrees, `sound` [N] in -1 to 1 at 16 kHz."""
    colors = colors or {}
    times = [index / rate for index in range(len(images))] if times is None else times
    with av.open(str(path), "w", options=muxer or {}) as container:
        container.metadata.update(metadata or {})
        repeatable = REPEATABLE if codec == "libx264" else {}
        stream: Any = container.add_stream(codec, rate=rate, options=repeatable | (options or {}))
        stream.height, stream.width, _ = images[0].shape
        stream.pix_fmt = pixels
        stream.codec_context.time_base = Fraction(1, rate if path.suffix == ".avi" else TICKS)
        for name, value in colors.items():
            setattr(stream.codec_context, name, value)
        if interlaced:
            stream.codec_context.flags |= Flags.interlaced_dct
        if turn:
            stream.set_display_rotation(turn)
        audio: Any = None if sound is None else container.add_stream("aac", rate=16000, layout="mono")
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame = frame.reformat(format=pixels, interpolation=ACCURATE, dst_colorspace=colors.get("colorspace"))
            frame.pts, frame.time_base = round(time * TICKS), Fraction(1, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if sound is not None:
            write_sound(container, audio, sound)
    return path


def write_sound(container: Any, stream: Any, sound: np.ndarray) -> None:
    """Encode [N] in -1 to 1."""
    for start in range(0, len(sound), 1024):
        samples = sound[None, start : start + 1024].astype(np.float32)
        frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(samples), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = 16000, start, Fraction(1, 16000)
        container.mux(stream.encode(frame))
    container.mux(stream.encode())
