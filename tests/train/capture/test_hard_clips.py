"""Recordings that can't give a scene get a verdict in words, and no dataset."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.process import EXIT_INVALID
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.cli.main import main
from tests.support.camera_moves import arc, pan, tripod
from tests.support.clips import clip_of_poses, views_of_poses
from tests.train.capture.clips import pictures, write_clip

pytestmark = pytest.mark.slow


def refused(recording: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What the command says about a recording that gives no scene; a report is there, and no dataset."""
    assert main(["capture", str(recording), str(data), "--threads", "1"]) == EXIT_INVALID
    told = capsys.readouterr()
    assert not told.err
    assert not {"sparse", "images", "times.json", "motion_masks"} & {path.name for path in data.iterdir()}
    assert "no scene can be made of this" in told.out
    assert "next: msdgs-train fit" not in told.out
    report = json.loads((data / "capture.json").read_text(encoding="utf-8"))
    assert report["verdict"]["level"] == "no scene"
    (finding,) = report["verdict"]["findings"]
    assert finding["problem"] in (data / "capture.html").read_text(encoding="utf-8").replace("&#x27;", "'")
    return finding["problem"]


def test_a_tripod(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = clip_of_poses(tmp_path / "clip.mp4", tripod(14), width=192)
    assert "one fixed camera can't give a scene" in refused(clip.file, tmp_path / "data", capsys)


def test_a_pure_pan(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """COLMAP finds poses for it, with small errors."""
    clip = clip_of_poses(tmp_path / "clip.mp4", pan(25, 12), width=192)
    assert "only turns" in refused(clip.file, tmp_path / "data", capsys)


def test_8_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip.mp4", pictures(8))
    assert "8 frames, of 8 in the recording, are too few" in refused(clip, tmp_path / "data", capsys)


def test_a_cut_in_the_middle(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Two rooms, each of which alone would do."""
    first = [image for image, _ in views_of_poses(arc(30, 12), 160)]
    second = [255 - image[::-1] for image, _ in views_of_poses(arc(30, 12), 160, seed=7)]
    clip = write_clip(tmp_path / "clip.mp4", [*first, *second], rate=10)
    problem = refused(clip, tmp_path / "data", capsys)
    assert "break off at 1.2 s, as at a cut" in problem


def test_black_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    dark = [np.zeros((64, 96, 3), np.uint8)] * 20
    clip = write_clip(tmp_path / "dark.mp4", dark)
    assert main(["capture", str(clip), str(tmp_path / "dark")]) == EXIT_INVALID
    assert "black" in capsys.readouterr().err
    clip = write_clip(tmp_path / "clip.mp4", [*pictures(12), *dark])
    assert "of the recording is black" in refused(clip, tmp_path / "data", capsys)


READABLE = {
    "portrait with a rotation flag": ({"turn": 90}, (64, 96)),
    "variable frame rate": ({"times": [0, 0.1, 0.15, 0.5, 0.6, 1.3]}, (96, 64)),
    "10 bit": ({"pixels": "yuv420p10le"}, (96, 64)),
}


@pytest.mark.parametrize(("options", "size"), READABLE.values(), ids=READABLE)
def test_unusual_videos_are_read(
    options: dict, size: tuple[int, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """They are too short for a scene; what they give up to there is right."""
    clip = write_clip(tmp_path / "clip.mp4", pictures(6), **options)
    assert "are too few" in refused(clip, tmp_path / "data", capsys)
    frames = FrameSet.load(tmp_path / "data" / "capture" / "frames" / "frames.json")
    assert (frames.cameras[0].width, frames.cameras[0].height) == size
    times = options.get("times", np.arange(6) / 30)
    assert [frame.time for frame in frames.frames] == pytest.approx(list(times), abs=1e-3)


def test_4k_of_10_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    images = [np.kron(image, np.ones((34, 40, 1), np.uint8))[:2160] for image in pictures(2)]
    clip = write_clip(tmp_path / "clip.mkv", images, codec="ffv1", pixels="yuv420p10le")
    assert "are too few" in refused(clip, tmp_path / "data", capsys)
    frames = FrameSet.load(tmp_path / "data" / "capture" / "frames" / "frames.json")
    assert (frames.cameras[0].width, frames.cameras[0].height) == (1024, 576)


def test_a_file_without_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    text = tmp_path / "notes.mp4"
    text.write_text("no video")
    assert main(["capture", str(text), str(tmp_path / "data")]) == EXIT_INVALID
    assert "notes.mp4" in capsys.readouterr().err


def test_a_truncated_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    whole = write_clip(tmp_path / "whole.mkv", pictures(16), codec="ffv1")
    content = whole.read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(content[: len(content) // 2])
    assert "are too few" in refused(cut, tmp_path / "data", capsys)
    shutil.rmtree(tmp_path / "data")
    cut.write_bytes(content[:40])
    assert main(["capture", str(cut), str(tmp_path / "data")]) == EXIT_INVALID
    assert "cut.mkv" in capsys.readouterr().err
