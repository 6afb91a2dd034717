"""`msdgs-train capture` from a video to a dataset that loads, its steps, what it refuses, and that it tells nothing."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.capture import job as job_module
from msdgs_train.capture import recordings as recordings_module
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.recordings import claim, digest_of, held
from msdgs_train.cli.capture import Capture
from msdgs_train.cli.main import _parse, main
from msdgs_train.datasets import load_scene
from tests.support.processes import ROOT
from tests.train.capture.clips import pictures, write_clip
from tests.train.capture.conftest import NAME, PLANTED, Captured

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("captured")]


def test_a_clip_becomes_a_scene_with_its_times(captured: Captured):
    assert captured.status == 0
    scene = load_scene(captured.data)
    assert sum(map(len, scene.splits.values())) == 16
    times = json.loads((captured.data / "times.json").read_text(encoding="utf-8"))["times"]
    assert sorted(times.values()) == pytest.approx(captured.clip.times, abs=1e-3)
    verdict = json.loads((captured.data / "capture.json").read_text(encoding="utf-8"))
    assert (verdict["registered"], verdict["verdict"]["level"]) == (16, "usable")
    assert "16 frames are few" in verdict["verdict"]["findings"][0]["problem"]


def test_masks_of_what_moves_are_none_of_the_loss(captured: Captured):
    scene = load_scene(captured.data)
    assert len(list((captured.data / "motion_masks").iterdir())) == 16
    assert all(frame.mask_path is None for frames in scene.splits.values() for frame in frames)


def test_nothing_tells_place_device_date_or_path(captured: Captured):
    """All files of the dataset, also those of the steps, by names and bytes."""
    planted = [NAME, *PLANTED.values(), *PLANTED, "48.8584", "Planted", "2023-04-05", "20230405", "PlantedFolder"]
    planted += [str(captured.data.parent), str(ROOT), str(Path.home())]
    files = [path for path in captured.data.rglob("*") if path.is_file()]
    assert {"capture.html", "capture.json", "times.json", "frames.json", "geometry.npz"} <= {f.name for f in files}
    for file in files:
        names = str(file.relative_to(captured.data)).encode()
        content = names + b"\0" + file.read_bytes()
        if file.suffix == ".npz":
            with np.load(file) as arrays:
                content += b"\0".join(
                    str(arrays[key].tolist()).encode() for key in arrays if arrays[key].dtype.kind == "U"
                )
        for text in filter(None, planted):
            for coded in (text.encode(), text.encode("utf-16-le")):
                assert coded not in content, (file.name, text)


def test_the_same_command_keeps_everything(captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    data, recording = _copied(captured, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in data.rglob("*.png")}
    assert main(["capture", str(recording), str(data), "--threads", "1"]) == 0
    output = capsys.readouterr().out
    assert "done" not in output
    assert output.count(": kept") == len(list((data / "capture").glob("*/step.json")))
    assert {path: path.stat().st_mtime_ns for path in data.rglob("*.png")} == before
    assert f"next: msdgs-train fit {data} RUN --minutes 30" in output


def test_force_step_repeats_it_and_what_follows(captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    data, recording = _copied(captured, tmp_path)
    assert main(["capture", str(recording), str(data), "--threads", "1", "--force-step", "dataset"]) == 0
    output = capsys.readouterr().out
    assert "poses: kept" in output
    assert "dataset: done" in output
    assert "report: done" in output
    for name in ("images.bin", "cameras.bin", "points3D.bin"):
        old, new = (folder / "sparse" / "0" / name for folder in (captured.data, data))
        assert old.read_bytes() == new.read_bytes()


def _copied(captured: Captured, folder: Path) -> tuple[Path, Path]:
    data = folder / "elsewhere"
    shutil.copytree(captured.data, data)
    return data, captured.data.parent / NAME


def test_ctrl_c_leaves_the_finished_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    clip = write_clip(tmp_path / "clip.mp4", pictures(20))
    with monkeypatch.context() as patched:
        patched.setattr("msdgs_train.capture.masked_poses.find_poses", interrupted)
        assert main(["capture", str(clip), str(tmp_path / "data")]) == 130
    left = sorted(path.name for path in (tmp_path / "data" / "capture").iterdir())
    assert left == ["frames", "recordings.json"]


def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip.mp4", pictures(4))
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter").write_text("kept")
    assert main(["capture", str(clip), str(tmp_path / "thesis")]) == EXIT_INVALID
    assert "holds other files" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "thesis").iterdir()] == ["chapter"]
    assert main(["capture", str(clip), str(clip)]) == EXIT_INVALID
    assert "a folder" in capsys.readouterr().err
    assert clip.stat().st_size > 1000


def test_a_folder_of_another_recording_is_refused(
    captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    clip = write_clip(tmp_path / "clip.mp4", pictures(4))
    assert main(["capture", str(clip), str(captured.data)]) == EXIT_INVALID
    assert "other recordings" in capsys.readouterr().err


def test_digests_follow_contents_order_and_names_of_images_and_not_those_of_recordings(tmp_path: Path):
    one, other = tmp_path / "a.mp4", tmp_path / "b.mp4"
    one.write_bytes(b"one")
    other.write_bytes(b"other")
    assert digest_of([one, other]) != digest_of([other, one])
    moved = tmp_path / "moved" / "c.mp4"
    moved.parent.mkdir()
    shutil.copy(one, moved)
    assert digest_of([moved, other]) == digest_of([one, other])
    folder = tmp_path / "two"
    folder.mkdir()
    for file in (one, other):
        shutil.copy(file, folder)
    before = digest_of([folder])
    assert before != digest_of([one, other])
    assert digest_of([folder.rename(tmp_path / "renamed")]) == before
    folder = tmp_path / "renamed"
    (folder / "b.mp4").rename(folder / "c.mp4")
    assert digest_of([folder]) != before
    with pytest.raises(CaptureFailed, match=r"images: is the same recording as .*renamed"):
        digest_of([folder, shutil.copytree(folder, tmp_path / "images")])
    with pytest.raises(CaptureFailed, match=r"c\.mp4: is the same recording as .*a\.mp4"):
        digest_of([one, other, moved])
    claim(tmp_path / "data", digest_of([one]))
    claim(tmp_path / "data", digest_of([moved]))


def test_a_folder_in_which_nothing_was_captured_is_free_for_other_recordings(tmp_path: Path):
    data = tmp_path / "data"
    claim(data, "one")
    claim(data, "other")
    (data / "capture" / "frames").mkdir()
    with pytest.raises(InvalidInput, match="other recordings"):
        claim(data, "one")


def test_two_captures_into_one_folder_at_once_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clip = write_clip(tmp_path / "clip.mp4", pictures(4))
    data = tmp_path / "data"
    claim(data, digest_of([clip]))
    with held(data):
        assert main(["capture", str(clip), str(data)]) == EXIT_INVALID
    assert "a folder into which no other process captures" in capsys.readouterr().err
    assert [path.name for path in (data / "capture").iterdir()] == ["recordings.json"]
    with held(data):
        pass


def test_a_full_disk_is_told_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    class Usage:
        free = 10**6

    clip = write_clip(tmp_path / "clip.mp4", pictures(50))
    monkeypatch.setattr(recordings_module.shutil, "disk_usage", lambda path: Usage)
    monkeypatch.setattr(job_module, "take_frames", lambda *args, **options: pytest.fail("it started"))
    assert main(["capture", str(clip), str(tmp_path / "data"), "--frames", "40"]) == EXIT_INVALID
    captured = capsys.readouterr()
    assert "takes up to 0.2 GB" in captured.out
    assert "needs up to 0.2 GB on a disk that has 0.0 GB free" in captured.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["clip.mp4"], "one recording or more, then DATA"),
        ([], "one recording or more, then DATA"),
        (["--times-from", "clip.mp4"], "DATA alone"),
        (["--times-from", "clip.mp4", "a.mp4", "data"], "DATA alone"),
        (["missing.mp4", "data"], "missing.mp4"),
        (["clip.mp4", "data", "--frames", "0"], "`frames`"),
        (["clip.mp4", "data", "--size", "-1"], "`size`"),
        (["clip.mp4", "data", "--size", "1"], "`size`"),
        (["clip.mp4", "data", "--seed", "-1"], "`seed`"),
        (["clip.mp4", "data", "--seed", str(2**31)], "`seed`"),
        (["clip.mp4", "data", "--threads", "0"], "`threads`"),
        (["clip.mp4", "data", "--offsets", "0", "0.1"], "`offsets` must be one finite number for each recording, 1"),
        (["clip.mp4", "clip.mp4", "data"], "is the same recording as clip.mp4"),
    ],
)
def test_wrong_arguments_are_named(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "clip.mp4", pictures(2))
    assert main(["capture", *arguments]) == EXIT_INVALID
    assert words in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("package", ["cv2", "av", "pycolmap", "scipy"])
def test_without_the_extra_it_says_what_to_install(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, package, None)  # as Python marks a package that can't be imported
    assert main(["capture", "clip.mp4", str(tmp_path / "data")]) == EXIT_INVALID
    assert f"needs {package}: pip install 'msdgs[capture]'" in capsys.readouterr().err


def test_help_teaches(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["capture", "--help"])
    output = capsys.readouterr().out
    for words in ("capture.html", "--times-from", "--force-step", "data/clip", "msdgs[capture]"):
        assert words in output


def test_the_commands_of_the_docs_are_accepted():
    lines = [
        line.split("#")[0].split()[1:]
        for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
        for line in page.read_text(encoding="utf-8").splitlines()
        if line.startswith("msdgs-train capture ")
    ]
    assert len(lines) >= 3
    commands = [_parse(line) for line in lines]
    assert all(isinstance(command, Capture) and command.paths for command in commands)
