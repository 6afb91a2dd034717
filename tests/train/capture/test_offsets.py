"""Starts of several videos by their sound."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import resample_poly

from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.offsets import MIN_CONFIDENCE, find_offsets
from tests.train.capture.clips import pictures, write_clip

RATE = 16000
HALF_A_FRAME = 0.5 / 30


def event(seconds: float, seed: int = 0) -> np.ndarray:
    """Knocks of different lengths, loudness and tone."""
    rng = np.random.default_rng(seed)
    sound = np.zeros(round(seconds * RATE))
    for start in rng.integers(0, len(sound) - 4000, round(4 * seconds)):
        decay = np.exp(-np.arange(4000) / rng.uniform(100, 800))
        sound[start : start + 4000] += rng.uniform(0.05, 0.3) * decay * rng.normal(size=4000)
    return sound


def heard(sound: np.ndarray, seed: int) -> np.ndarray:
    """By a microphone with its own gain, tone, echoes and noise, 10 dB below the sound."""
    rng = np.random.default_rng(seed)
    echoes = np.zeros(1600)
    echoes[0] = 1
    echoes[rng.integers(50, 1600, 10)] = rng.normal(0, 0.3, 10)
    taken = np.convolve(np.convolve(sound, echoes)[: len(sound)], [1, *rng.normal(0, 0.2, 8)])[: len(sound)]
    taken = taken + rng.normal(0, 0.3 * taken.std(), len(taken))
    return np.clip(rng.uniform(0.1, 0.9) * taken / np.abs(taken).max(), -1, 1)


def write(folder: Path, name: str, sound: np.ndarray | None, start: float = 0.0) -> Path:
    return write_clip(folder / name, pictures(3), times=[start + i / 30 for i in range(3)], sound=sound)


@pytest.mark.parametrize("apart", [[0.0, 0.1, 0.4, 0.237], [0.0, -0.35, 5.2, -3.9]])
def test_starts_are_found_within_half_a_frame(tmp_path: Path, apart: list[float]):
    sound, seconds = event(16), 8
    videos = []
    for index, offset in enumerate(apart):
        first = round((4 + offset) * RATE)
        videos.append(write(tmp_path, f"{index}.mp4", heard(sound[first : first + seconds * RATE], index)))
    found = find_offsets(videos)
    assert np.abs(np.array(found.seconds) - apart).max() < HALF_A_FRAME
    assert found.seconds[0] == 0
    assert min(found.confidence) >= MIN_CONFIDENCE


def test_starts_are_those_of_the_pictures(tmp_path: Path):
    """The pictures of the second video begin 0.2 s after its sound."""
    sound = event(6)
    videos = [write(tmp_path, "a.mp4", heard(sound, 0)), write(tmp_path, "b.mp4", heard(sound, 1), start=0.2)]
    assert find_offsets(videos).seconds[1] == pytest.approx(0.2, abs=HALF_A_FRAME)


def test_unrelated_sounds_and_silence_give_equal_starts_and_it_is_said(tmp_path: Path):
    videos: list[Path] = []
    for seed in range(4):
        videos = [write(tmp_path, f"{k}.mp4", heard(event(5, seed=10 * seed + k), k)) for k in range(2)]
        found = find_offsets(videos)
        assert min(found.confidence) < MIN_CONFIDENCE
        assert found.seconds == (0.0, 0.0)
        assert "The sound of 1.mp4 doesn't match that of the others" in found.note
    videos += [write(tmp_path, "mute.mp4", None), write(tmp_path, "still.mp4", np.zeros(RATE))]
    found = find_offsets(videos)
    assert min(found.confidence) < MIN_CONFIDENCE
    assert found.seconds == (0.0,) * 4
    assert "no sound in mute.mp4, still.mp4" in found.note


def test_clocks_that_differ_a_little_do_no_harm(tmp_path: Path):
    sound = event(20)
    slow = resample_poly(sound, 10000, 9999)[RATE : RATE * 18]  # 100 parts in a million: 1.7 ms over the video
    videos = [write(tmp_path, "a.mp4", heard(sound, 0)), write(tmp_path, "b.mp4", heard(slow, 1))]
    assert find_offsets(videos).seconds[1] == pytest.approx(1.0, abs=HALF_A_FRAME)


def test_a_file_that_is_no_video_is_refused(tmp_path: Path):
    (tmp_path / "a.mp4").write_bytes(b"-" * 500)
    with pytest.raises(CaptureFailed, match=r"a\.mp4: can't be read"):
        find_offsets([tmp_path / "a.mp4", tmp_path / "a.mp4"])
