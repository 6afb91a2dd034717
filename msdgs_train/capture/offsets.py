"""When several videos of one event start, by their sound.

Sounds are compared by generalized cross-correlation with phase transform (Knapp and Carter 1976): only phases count, so
that microphones, distances and gains may differ. The sound is used for nothing else.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_train.capture.image_source import starts_by_names
from msdgs_train.capture.video_source import VideoSource, opened

RATE = 8000
"""Samples per second that sounds are compared at."""
BAND = (100.0, 3800.0)
"""Hz; rumble below it has no clear phase."""
MAX_SECONDS = 1200
"""Of each sound that are compared."""
WIDTH = 0.002
"""Standard deviation in seconds of the smoothing of the correlation: paths of sound and clocks differ by as much."""
APART = 0.1
"""Seconds from the peak from which on other peaks are other offsets."""
MIN_CONFIDENCE = 1.5
"""Unrelated sounds have less; `tests/train/capture/test_offsets.py` measures it."""


class Offsets(NamedTuple):
    """When videos start."""

    seconds: tuple[float, ...]
    """By which the first frame of each comes after that of the first video."""
    confidence: tuple[float, ...]
    """Height of the correlation's peak relative to the next highest; 0 where it isn't known."""
    note: str
    """How they were found, a sentence."""


class Sound(NamedTuple):
    """The sound of a video."""

    samples: np.ndarray  # float32 [N]
    start: float  # seconds by which it begins after the first frame of the video


def find_offsets(videos: Sequence[Path]) -> Offsets:
    """Find when each video starts after the first one. Raises `CaptureFailed` for files that can't be read."""
    nothing = (0.0,) * len(videos)
    if starts := starts_by_names(videos):
        return Offsets(starts, nothing, "Starts are found by the times and numbers in the images' names.")
    if any(video.is_dir() for video in videos):
        return Offsets(nothing, nothing, "Folders of images have no sound: all are taken to start together.")
    sounds = [read_sound(video) for video in videos]
    silent = [video.name for video, sound in zip(videos, sounds, strict=True) if sound is None]
    if silent:
        problem = f"There is no sound in {', '.join(silent)}"
        return Offsets(nothing, nothing, f"{problem}: all are taken to start together, give --offsets.")
    seconds, confidence = _chained([sound for sound in sounds if sound is not None])
    unclear = [video.name for video, each in zip(videos, confidence, strict=True) if each < MIN_CONFIDENCE]
    if unclear:
        problem = f"The sound of {', '.join(unclear)} doesn't match that of the others"
        return Offsets(nothing, tuple(confidence), f"{problem}: all are taken to start together, give --offsets.")
    return Offsets(tuple(seconds), tuple(confidence), "Starts are found by sound.")


def read_sound(video: Path) -> Sound | None:
    """Read the sound as one channel at `RATE`; None if there is none."""
    with opened(video) as container:
        import av

        if not container.streams.audio:
            return None
        stream = container.streams.audio[0]
        resampler, parts, start, count = av.AudioResampler("flt", "mono", RATE), [], None, 0
        for frame in container.decode(stream):
            start = float((frame.pts or 0) * stream.time_base) if start is None else start
            for part in resampler.resample(frame):
                parts.append(part.to_ndarray().ravel())
                count += len(parts[-1])
            if count > MAX_SECONDS * RATE:
                break
    if start is None or not (samples := np.concatenate(parts)).any():
        return None
    return Sound(samples[: MAX_SECONDS * RATE], start - VideoSource(video, 1).start)


def _chained(sounds: Sequence[Sound]) -> tuple[list[float], list[float]]:
    """Offsets and confidences: each against the first, or if that isn't clear against one that is known."""
    seconds, confidence = [0.0] * len(sounds), [0.0] * len(sounds)
    confidence[0] = np.inf
    for known in range(len(sounds)):
        if confidence[known] < MIN_CONFIDENCE:
            continue
        for index in range(1, len(sounds)):
            if confidence[index] < MIN_CONFIDENCE:
                delay, found = _delay(sounds[known], sounds[index])
                if found > confidence[index]:
                    seconds[index], confidence[index] = seconds[known] + delay, found
    return seconds, confidence


def _delay(one: Sound, two: Sound) -> tuple[float, float]:
    """Seconds by which the video `two` starts after `one`, and the confidence."""
    from scipy import fft

    length = 1 << (len(one.samples) + len(two.samples) - 1).bit_length()
    spectra = [np.asarray(fft.rfft(sound.samples, length)) for sound in (one, two)]
    cross = spectra[0] * spectra[1].conj()
    frequency = np.fft.rfftfreq(length, 1 / RATE)
    cross[(frequency < BAND[0]) | (frequency > BAND[1])] = 0
    strength = np.abs(cross)
    phases = np.divide(cross, strength, out=np.zeros_like(cross), where=strength > 0)
    energy = np.square(np.asarray(fft.irfft(phases, length)))
    smoothing = np.exp(-0.5 * (2 * np.pi * frequency * WIDTH) ** 2)
    power = np.maximum(np.asarray(fft.irfft(np.asarray(fft.rfft(energy)) * smoothing, length)), 0)
    peak = int(power.argmax())
    lag = peak - length if peak >= len(one.samples) else peak
    away = np.roll(power, -peak)[int(APART * RATE) : -int(APART * RATE)]
    confidence = float(np.sqrt(power[peak] / max(away.max(initial=0), 1e-30)))
    return lag / RATE + one.start - two.start, confidence
