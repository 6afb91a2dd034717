"""Times of images that another program took from a video."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.times_from import times_from
from msdgs_train.datasets import load_scene
from msdgs_train.datasets.common.readers import DatasetInvalid
from tests.train.capture.clips import picture, write_clip
from tests.train.datasets.layouts import nerfstudio_json
from tests.train.datasets.lens import Lens

TIMES = [index / 30 + 0.4 * (index >= 20) for index in range(40)]
TAKEN = list(range(3, 39, 5))


def view(index: int, seed: int = 0) -> np.ndarray:
    """A frame of 192 × 128 pixels."""
    return picture(index, 192, 128, seed)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "clip.mp4", [view(i) for i in range(40)], times=TIMES)


def write_dataset(folder: Path, images: list[np.ndarray], ending: str = "jpg") -> Path:
    """A nerfstudio dataset."""
    content = nerfstudio_json(len(images), Lens(width=192, height=128))
    (folder / "images").mkdir()
    for index, (frame, image) in enumerate(zip(content["frames"], images, strict=True)):
        frame["file_path"] = f"images/frame_{index + 1}.{ending}"
        cv2.imwrite(str(folder / frame["file_path"]), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 60])
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def undistorted(image: np.ndarray) -> np.ndarray:
    camera = np.array([[160.0, 0, 96], [0, 160, 64], [0, 0, 1]])
    return cv2.undistort(image, camera, np.array([-0.15, 0.04, 0.001, -0.001, 0]))


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as they are": lambda image: image,
    "half the size": lambda image: cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
    "undistorted": undistorted,
    "cropped": lambda image: image[6:-6, 9:-9],
    "brighter": lambda image: np.clip(1.2 * image + 10, 0, 255).astype(np.uint8),
}


@pytest.mark.parametrize("change", CHANGES)
def test_each_image_gets_the_time_of_its_frame(tmp_path: Path, clip: Path, change: str):
    write_dataset(tmp_path, [CHANGES[change](view(index)) for index in TAKEN])
    times = times_from(clip, tmp_path)
    close = 1 / 30 if change == "undistorted" else 0  # at its edges it moves by more than the video in a frame
    assert list(times.values()) == pytest.approx([TIMES[index] for index in TAKEN], abs=close + 0.001)
    stored = json.loads((tmp_path / "times.json").read_text())
    assert stored == {"unit": "seconds", "times": times}
    assert list(times)[:2] == ["images/frame_1.jpg", "images/frame_2.jpg"]


def test_the_dataset_is_loaded_with_them(tmp_path: Path, clip: Path):
    times = times_from(clip, write_dataset(tmp_path, [view(index) for index in TAKEN]))
    scene = load_scene(tmp_path)
    loaded = sorted(frame.t for frames in scene.splits.values() for frame in frames)
    last = max(times.values())
    assert loaded[0] < loaded[-1] <= 1
    assert last > 1  # so that they are scaled
    wanted = np.array(sorted(times.values()))
    assert loaded == pytest.approx((wanted - wanted[0]) / (wanted[-1] - wanted[0]))


def test_colmaps_images_get_times(tmp_path: Path, clip: Path):
    write_dataset(tmp_path, [view(index) for index in TAKEN], "png")
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "sparse").mkdir()
    (tmp_path / "images" / "._00000.png").write_bytes(b"of macOS")
    assert list(times_from(clip, tmp_path).values()) == pytest.approx([TIMES[index] for index in TAKEN], abs=0.001)


def test_images_of_another_video_are_refused(tmp_path: Path, clip: Path):
    write_dataset(tmp_path, [view(index, seed=5) for index in TAKEN])
    with pytest.raises(CaptureFailed, match=r"frame_\d\.jpg: isn't a frame of clip\.mp4"):
        times_from(clip, tmp_path)
    assert not (tmp_path / "times.json").exists()


def test_one_foreign_image_and_another_order_are_refused(tmp_path: Path, clip: Path):
    (tmp_path / "one").mkdir()
    write_dataset(tmp_path / "one", [view(index, seed=5 * (index == 18)) for index in TAKEN])
    with pytest.raises(CaptureFailed, match=r"images/frame_4\.jpg: isn't a frame of clip\.mp4, or the images are in"):
        times_from(clip, tmp_path / "one")
    (tmp_path / "back").mkdir()
    write_dataset(tmp_path / "back", [view(index) for index in TAKEN[::-1]])
    with pytest.raises(CaptureFailed, match="the images are in another order"):
        times_from(clip, tmp_path / "back")


def test_a_missing_image_is_named(tmp_path: Path, clip: Path):
    write_dataset(tmp_path, [view(index) for index in TAKEN])
    (tmp_path / "images" / "frame_3.jpg").unlink()
    with pytest.raises(DatasetInvalid, match=r"names images/frame_3\.jpg, but there is no such file"):
        times_from(clip, tmp_path)
    assert not (tmp_path / "times.json").exists()


def test_a_folder_that_needs_no_times_or_is_no_dataset_is_refused(tmp_path: Path, clip: Path):
    with pytest.raises(InvalidInput, match=r"`folder` must be a dataset with transforms\.json or sparse"):
        times_from(clip, tmp_path)
    write_dataset(tmp_path, [view(index) for index in range(3)])
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][1]["time"] = 0.5
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CaptureFailed, match=r"transforms\.json: has times of its own"):
        times_from(clip, tmp_path)
