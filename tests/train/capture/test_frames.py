"""Which frames are taken of a video, and with which times."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.frames import extract_frames
from tests.train.capture.clips import HEIGHT, WIDTH, picture, pictures, write_clip

UNEVEN = [0, 0.033, 0.066, 0.2, 0.233, 0.5, 0.533, 0.566, 0.6, 0.9, 1.0, 1.1]
LOSSLESS = {"crf": "0"}


def times(frames: FrameSet, camera: int = 0) -> list[float]:
    return [frame.time for frame in frames.frames if frame.camera == camera]


def numbers(frames: FrameSet) -> list[int]:
    return [int(Path(frame.name).stem) for frame in frames.frames]


def read(folder: Path, name: str) -> np.ndarray:
    image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image[..., ::-1].astype(int)


@pytest.mark.parametrize("start", [0.0, 1.4])
@pytest.mark.parametrize(
    ("name", "codec"),
    [("a.mp4", "libx264"), ("a.mov", "libx264"), ("a.mkv", "libx264"), ("a.webm", "libvpx-vp9"), ("a.ts", "libx264")],
)
def test_times_are_those_of_the_presentation(tmp_path: Path, name: str, codec: str, start: float):
    """Of a variable frame rate, B-frames, and an edit list where the first frame isn't at 0."""
    clip = write_clip(tmp_path / name, pictures(12), times=[start + time for time in UNEVEN], codec=codec)
    frames = extract_frames([clip], tmp_path / "out")
    assert times(frames) == pytest.approx(UNEVEN, abs=0.001)
    assert numbers(frames) == list(range(12))
    assert frames.notes == ()
    camera = frames.cameras[0]
    assert (camera.name, camera.width, camera.height, camera.available) == ("", WIDTH, HEIGHT, 12)
    assert camera.duration == pytest.approx(1.1, abs=0.001)


def test_pictures_are_those_of_their_times(tmp_path: Path):
    clip = write_clip(tmp_path / "clip.mp4", pictures(8), options=LOSSLESS)
    frames = extract_frames([clip], tmp_path / "out")
    for frame, number in zip(frames.frames, numbers(frames), strict=True):
        wanted = picture(number)
        assert np.abs(read(tmp_path / "out", frame.name) - wanted).mean() < 3  # chroma has half of the pixels


def test_a_gif_has_hundredths_of_a_second(tmp_path: Path):
    clip = write_clip(
        tmp_path / "clip.gif", pictures(6), times=[0, 0.1, 0.15, 0.4, 0.5, 0.7], codec="gif", pixels="rgb8"
    )
    assert times(extract_frames([clip], tmp_path / "out")) == pytest.approx([0, 0.1, 0.15, 0.4, 0.5, 0.7], abs=0.011)


@pytest.mark.parametrize(("name", "codec", "rate"), [("a.h264", "libx264", 25), ("a.avi", "libx264", 30)])
def test_missing_times_are_taken_from_the_rate_and_it_is_said(tmp_path: Path, name: str, codec: str, rate: int):
    """A bare H.264 stream, and an AVI with B-frames, store the order of decoding only."""
    frames = extract_frames([write_clip(tmp_path / name, pictures(12), codec=codec)], tmp_path / "out")
    assert times(frames) == pytest.approx(np.arange(12) / rate)
    assert f"no usable times for 12 frames: they are taken to follow at {rate} frames per second" in frames.notes[0]


def test_an_avi_without_b_frames_has_times(tmp_path: Path):
    frames = extract_frames([write_clip(tmp_path / "a.avi", pictures(12), codec="mpeg4")], tmp_path / "out")
    assert times(frames) == pytest.approx(np.arange(12) / 30)
    assert frames.notes == ()


def test_of_each_interval_the_sharpest_frame_is_taken(tmp_path: Path):
    images = [
        cv2.GaussianBlur(image, (0, 0), 2.5) if index % 3 != 1 else image for index, image in enumerate(pictures(30))
    ]
    frames = extract_frames([write_clip(tmp_path / "clip.mp4", images, options=LOSSLESS)], tmp_path / "out", frames=10)
    assert numbers(frames) == list(range(1, 30, 3))
    assert times(frames) == pytest.approx(np.arange(1, 30, 3) / 30)
    assert sorted(file.stem for file in (tmp_path / "out").iterdir()) == [f"{n:05}" for n in range(1, 30, 3)]


def test_gaps_in_time_stay_gaps(tmp_path: Path):
    gap = [index / 30 + 2 * (index >= 10) for index in range(20)]
    frames = extract_frames([write_clip(tmp_path / "clip.mp4", pictures(20), times=gap)], tmp_path / "out", frames=16)
    assert max(np.diff(times(frames))) >= 2
    assert set(np.round(times(frames), 3)) <= set(np.round(gap, 3))
    assert len(frames.frames) < 16


def test_blurred_intervals_are_left_out_and_counted(tmp_path: Path):
    images = [cv2.blur(image, (15, 1)) if 8 <= index < 12 else image for index, image in enumerate(pictures(24))]
    frames = extract_frames([write_clip(tmp_path / "clip.mp4", images, options=LOSSLESS)], tmp_path / "out", frames=12)
    assert frames.blurred == 2
    assert not set(range(8, 12)) & set(numbers(frames))
    assert len(list((tmp_path / "out").iterdir())) == len(frames.frames) == 10


def test_repeated_pictures_are_left_out(tmp_path: Path):
    """As a clip of a variable frame rate becomes one of a constant rate by repeating frames."""
    order = [0, 1, 2, 2, 3, 4, 5, 5, 5, 6, 7, 8, 8, 9]
    images = pictures(10)
    clip = write_clip(tmp_path / "clip.mp4", [images[index] for index in order], options={"crf": "20", "bf": "0"})
    frames = extract_frames([clip], tmp_path / "out")
    assert frames.repeated == 4
    assert [order[number] for number in numbers(frames)] == list(range(10))
    assert times(frames) == pytest.approx(np.array([0, 1, 2, 4, 5, 6, 9, 10, 11, 13]) / 30)


def test_a_cut_is_found_and_a_pan_is_none(tmp_path: Path):
    clip = write_clip(tmp_path / "cut.mp4", pictures(12) + pictures(12, seed=3))
    assert extract_frames([clip], tmp_path / "out").cuts == pytest.approx((0.4,))
    pan = write_clip(tmp_path / "pan.mp4", [picture(4 * index) for index in range(12)])
    assert extract_frames([pan], tmp_path / "out2").cuts == ()


@pytest.mark.parametrize(("size", "wanted"), [(72, (72, 48)), (1024, (96, 64)), (64, (64, 43))])
def test_the_long_side_is_reduced_and_never_enlarged(tmp_path: Path, size: int, wanted: tuple[int, int]):
    frames = extract_frames([write_clip(tmp_path / "clip.mp4", pictures(2))], tmp_path / "out", size=size)
    assert (frames.cameras[0].width, frames.cameras[0].height) == wanted
    assert read(tmp_path / "out", frames.frames[0].name).shape == (*wanted[::-1], 3)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_portrait_is_turned_as_players_do(tmp_path: Path, degrees: int):
    clip = write_clip(tmp_path / "clip.mp4", pictures(2), turn=degrees, options=LOSSLESS)
    frames = extract_frames([clip], tmp_path / "out")
    shown = np.rot90(picture(0), degrees // 90).astype(int)
    assert (frames.cameras[0].height, frames.cameras[0].width) == shown.shape[:2]
    assert np.abs(read(tmp_path / "out", frames.frames[0].name) - shown).mean() < 3


def test_cameras_have_frames_at_the_same_moments(tmp_path: Path):
    """Although they start at other times, have other rates, and other frames of them are sharp."""
    sharp = [
        [cv2.blur(im, (9, 9)) if (i + k) % 4 else im for i, im in enumerate(pictures(60, seed=k))] for k in range(2)
    ]
    one = write_clip(tmp_path / "one.mp4", sharp[0])
    two = write_clip(tmp_path / "two.mp4", sharp[1], rate=25)
    frames = extract_frames([one, two], tmp_path / "out", frames=12, offsets=[5.0, 5.31])
    assert [camera.name for camera in frames.cameras] == ["cam01", "cam02"]
    assert [camera.offset for camera in frames.cameras] == pytest.approx([0, 0.31])
    assert {frame.name.split("/")[0] for frame in frames.frames} == {"cam01", "cam02"}
    first, second = np.array(times(frames)), np.array(times(frames, 1))
    common = first[(first > second[0]) & (first < second[-1])]
    assert len(common) >= 7
    assert np.abs(common[:, None] - second).min(axis=1).max() <= 0.5 / 25 + 1e-6
    assert second[-1] > first[-1]  # also where the first has none
    stored = np.array([int(Path(frame.name).stem) for frame in frames.frames if frame.camera == 1]) / 25 + 0.31
    assert second == pytest.approx(stored)


def test_offsets_are_one_a_video(tmp_path: Path):
    clip = write_clip(tmp_path / "clip.mp4", pictures(2))
    for offsets in ([0.0], [0.0, float("nan")], [0.0, 0.1, 0.2]):
        with pytest.raises(InvalidInput, match="`offsets` must be one finite number for each recording, 2"):
            extract_frames([clip, clip], tmp_path / "out", offsets=offsets)


def test_progress_reaches_the_end_and_what_is_stored_is_read_again(tmp_path: Path):
    seen: list[tuple[int, int]] = []
    clip = write_clip(tmp_path / "clip.mp4", pictures(6))
    frames = extract_frames([clip, clip], tmp_path / "out", progress=lambda done, total: seen.append((done, total)))
    assert seen == [(done, 12) for done in range(1, 13)]
    frames.save(tmp_path / "frames.json")
    assert FrameSet.load(tmp_path / "frames.json") == frames


def test_too_few_frames_and_pixels_are_refused(tmp_path: Path):
    clip = write_clip(tmp_path / "clip.mp4", pictures(2))
    with pytest.raises(InvalidInput, match=r"`frames` must be 1 or more, .* got 0"):
        extract_frames([clip], tmp_path / "out", frames=0)
    with pytest.raises(InvalidInput, match=r"`size` must be 64 or more, .* got 63"):
        extract_frames([clip], tmp_path / "out", size=63)
    with pytest.raises(CaptureFailed, match=r"none\.mp4: does not exist"):
        extract_frames([tmp_path / "none.mp4"], tmp_path / "out")


@pytest.mark.parametrize("offset", [0.4, -0.4, 400.0, 1e9])
def test_recordings_without_a_common_moment_are_refused(tmp_path: Path, offset: float):
    clips = [write_clip(tmp_path / f"{name}.mp4", pictures(4)) for name in ("one", "two")]
    with pytest.raises(InvalidInput, match=r"`offsets` must be seconds .* no other one shows a moment of recording 1"):
        extract_frames(clips, tmp_path / "out", offsets=[0.0, offset])
    assert not (tmp_path / "out").exists()
