"""Neu3D layout: splits, times and pixels of videos and of folders, the cache of decoded videos, and bad ones."""

import sys
from pathlib import Path

import av
import numpy as np
import pytest

from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common import video
from msdgs_train.datasets.common.images import resize_area, write_png
from tests.support.tolerances import assert_close, tolerance
from tests.train.datasets import layouts
from tests.train.datasets.layouts import (
    SMALL,
    points_of,
    poses_bounds,
    write_colmap,
    write_neu3d,
    write_neu3d_videos,
    write_video,
)

COUNT = 7


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "msdgs" / "videos"


def image(camera: int, index: int) -> np.ndarray:
    """The image of a camera's frame, of the size of these videos."""
    return layouts.flat(layouts.neu3d_color(camera, index), SMALL)


def test_names_in_capitals_and_hidden_files(tmp_path: Path):
    """Action cameras write `.MP4`, and macOS a `._` file beside each file in an archive."""
    for name in ("videos", "images"):
        (tmp_path / name).mkdir()
    videos, images = write_neu3d_videos(tmp_path / "videos"), write_neu3d(tmp_path / "images")
    (videos / "cam00.mp4").rename(videos / "cam00.MP4")
    (images / "cam00" / "._0000.png").write_bytes(b"no image")
    assert [len(load_scene(folder).splits["test"]) for folder in (videos, images)] == [COUNT, 2]


def test_cameras_whose_order_is_unclear_are_refused(tmp_path: Path):
    write_neu3d(tmp_path, SMALL, names=tuple(f"cam{number}" for number in range(3)), count=1)
    (tmp_path / "cam0").rename(tmp_path / "cam00")
    (tmp_path / "cam1").rename(tmp_path / "cam10")
    with pytest.raises(
        DatasetInvalid, match=r"`rows` may be in the order .* as texts, cam00 cam10 cam2: give all names"
    ):
        load_scene(tmp_path)


def test_videos_beside_another_layout_are_left_alone(tmp_path: Path):
    (write_colmap(tmp_path) / "cam01.mp4").write_bytes(b"a recording")
    assert load_scene(tmp_path).layout == "COLMAP"


def cut_start(video: Path, count: int) -> None:
    """Hide the first frames without encoding the others again, as `ffmpeg -ss … -c copy` does."""
    whole = video.rename(video.with_suffix(".whole"))
    with av.open(str(whole)) as source, av.open(str(video), "w") as cut:
        stream = source.streams.video[0]
        written = cut.add_stream_from_template(stream)
        for packet in source.demux(stream):
            if packet.pts is not None and packet.dts is not None and stream.time_base:
                shift = round(count / 30 / stream.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, written
                cut.mux(packet)


def test_frames_that_a_cut_without_encoding_hides_do_not_count(tmp_path: Path):
    write_neu3d_videos(tmp_path)
    for name in ("cam00.mp4", "cam01.mp4", "cam02.mp4"):
        cut_start(tmp_path / name, 3)
    frames = load_scene(tmp_path).splits["test"]
    assert len(frames) == COUNT - 3
    assert_close(frames[0].load_rgba()[..., :3].astype(float), image(0, 3).astype(float), "video_color")


def test_splits_times_and_pixels_of_videos(tmp_path: Path):
    scene = load_scene(write_neu3d_videos(tmp_path))
    assert [len(scene.splits[split]) for split in ("train", "val", "test")] == [2 * COUNT, 0, COUNT]
    assert scene.time_range == (0.0, 1.0)
    assert len({frame.image_path for frame in scene.splits["train"]}) == 2 * COUNT
    order = np.random.default_rng(0).permutation(2 * COUNT)
    for number in order:
        frame, camera, index = scene.splits["train"][number], 1 + number // COUNT, number % COUNT
        assert (frame.name, frame.t) == (f"cam{camera:02d}_{index:06d}", index / (COUNT - 1))
        rgba = frame.load_rgba()
        assert rgba.shape == (SMALL.height, SMALL.width, 4)
        assert (rgba[..., 3] == 255).all()
        assert_close(rgba[..., :3].astype(float), image(camera, index).astype(float), "video_color")


def test_splits_times_and_pixels_of_folders(tmp_path: Path):
    scene = load_scene(write_neu3d(tmp_path, count=3, below="images"))
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 0.5, 1.0]
    for camera, split in enumerate(("test", "train")):
        for index, frame in enumerate(scene.splits[split]):
            assert frame.name == f"cam{camera:02d}_{index:04d}"
            assert (frame.load_rgba()[..., :3] == layouts.neu3d_color(camera, index)).all()


def test_a_camera_may_be_left_out_and_numbers_of_frames_need_no_zeros(tmp_path: Path):
    write_neu3d(tmp_path, SMALL, names=("cam00", "cam02", "cam10"), count=1)
    for index in (10, 2):
        for camera, name in enumerate(("cam00", "cam02", "cam10")):
            write_png(tmp_path / name / f"{index}.png", image(camera, index))
    scene = load_scene(tmp_path)
    poses = np.load(tmp_path / "poses_bounds.npy")
    assert [frame.name for frame in scene.splits["test"]] == ["cam00_0000", "cam00_2", "cam00_10"]
    assert [frame.name[:5] for frame in scene.splits["train"][::3]] == ["cam02", "cam10"]
    for row, frame in zip(poses[1:], scene.splits["train"][::3], strict=True):
        assert (frame.camera.position == row[[3, 8, 13]]).all()


@pytest.mark.parametrize(
    ("folder", "names", "rows", "used"),
    [
        ("scene", ("cam00", "cam01", "cam03"), 4, {"cam01": 1, "cam03": 3}),
        ("coffee_martini", ("cam00", "cam12", "cam13", "cam14"), 4, {"cam12": 1, "cam14": 3}),
        ("coffee_martini", ("cam00", "cam12", "cam14"), 4, {"cam12": 1, "cam14": 3}),
        ("coffee_martini", ("cam00", "cam12", "cam14"), 3, {"cam12": 1, "cam14": 2}),
    ],
    ids=["missing", "not synchronized", "its video removed", "its row removed too"],
)
def test_cameras_that_are_missing_or_left_out(
    tmp_path: Path, folder: str, names: tuple[str, ...], rows: int, used: dict[str, int]
) -> None:
    """The test view isn't trained on."""
    (tmp_path / folder).mkdir()
    write_neu3d(tmp_path / folder, SMALL, names=names, count=1)
    poses = poses_bounds(rows, SMALL)
    poses[:, 3] = np.arange(rows)  # the first coordinate of the position
    np.save(tmp_path / folder / "poses_bounds.npy", poses)
    scene = load_scene(tmp_path / folder)
    assert {f.name.split("_")[0]: f.camera.position[0] for f in scene.splits["train"]} == used
    assert [f.name.split("_")[0] for f in scene.splits["test"]] == ["cam00"]


def waves(width: int, height: int) -> np.ndarray:
    """Color changes vertically only, since H.264 and FFmpeg's encoder differ in the horizontal position of chroma."""
    y, x = np.mgrid[0:height, 0:width]
    grey = 128 + 40 * np.sin(x / 9) * np.cos(y / 7)
    return np.stack([grey + 40 * np.sin(y / 6), grey, grey + 40 * np.cos(y / 5)], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("size", [160, 80, 40, 67])
def test_size_reduces_a_video_as_it_does_images(tmp_path: Path, size: int):
    drawings = [waves(160, 120), waves(160, 120)[::-1]]
    for name in ("cam00", "cam01"):
        write_video(tmp_path / f"{name}.mp4", drawings)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(2))
    for frame, drawn in zip(load_scene(tmp_path, size).splits["train"], drawings, strict=True):
        rgba = np.dstack([drawn, np.full((120, 160), 255, np.uint8)])
        want = resize_area(rgba, size, round(size * 0.75))[..., :3].astype(float)
        assert np.abs(frame.load_rgba()[..., :3] - want).mean() < tolerance("video_image.mean")


def test_the_color_matrix_is_the_one_that_the_video_names(tmp_path: Path):
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(2))
    for camera, colorspace in enumerate(("ITU601", "ITU709")):
        write_video(tmp_path / f"cam0{camera}.mp4", [image(0, 3)], colorspace)
    scene = load_scene(tmp_path)
    for split in ("train", "test"):
        loaded = scene.splits[split][0].load_rgba()[..., :3]
        assert_close(loaded.astype(float), image(0, 3).astype(float), "video_color")


def test_a_video_is_decoded_once_for_all_runs(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    first = load_scene(write_neu3d_videos(tmp_path)).splits["test"]
    pixels = [frame.load_rgba() for frame in first]
    (file,) = cache.iterdir()
    monkeypatch.setattr(video, "_decoded", lambda *_: pytest.fail("decoded again"))
    again = load_scene(tmp_path).splits["test"]
    assert all((frame.load_rgba() == known).all() for frame, known in zip(again, pixels, strict=True))
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file.write_bytes(file.read_bytes()[:-1])  # as after a crash
    assert (first[2].load_rgba() == pixels[2]).all()
    write_video(tmp_path / "cam00.mp4", [image(4, index) for index in range(COUNT)])
    changed = load_scene(tmp_path).splits["test"][0].load_rgba()
    assert_close(changed[..., :3].astype(float), image(4, 0).astype(float), "video_color")


def test_a_cache_that_cant_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "occupied").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "occupied"))
    frame = load_scene(write_neu3d_videos(tmp_path)).splits["test"][0]
    with pytest.raises(DatasetInvalid, match=r"cam00\.mp4: `video` can't be decoded into .*XDG_CACHE_HOME"):
        frame.load_rgba()


def test_a_video_that_is_cut_off_is_refused_and_leaves_nothing(tmp_path: Path, cache: Path):
    """The header at the start of the file has the number of frames."""
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(2))
    noise = np.random.default_rng(0).integers(0, 256, size=(COUNT, 96, 128, 3), dtype=np.uint8)
    for name in ("cam00", "cam01"):
        write_video(tmp_path / f"{name}.mp4", list(noise), movflags="faststart")
    path = tmp_path / "cam01.mp4"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frame = load_scene(tmp_path).splits["train"][0]
    with pytest.raises(DatasetInvalid, match=r"cam01\.mp4: `video` (has 7 frames by its header, but|can't be read)"):
        frame.load_rgba()
    assert not list(cache.iterdir())


def test_without_pyav_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_neu3d_videos(tmp_path)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(DatasetInvalid, match=r"`video` needs av to be read: pip install 'msdgs\[train\]'"):
        load_scene(tmp_path)


def test_points_beside_the_poses(tmp_path: Path):
    write_neu3d(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
    tail = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "points3D_downsample.ply").write_text("no points")
    (tmp_path / "points3D_downsample2.ply").write_text(header + tail + "1 2 3 255 0 51\n-0.5 0 0 0 0 0\n")
    points, colors = points_of(load_scene(tmp_path))
    assert points == [[1, 2, 3], [-0.5, 0, 0]]
    assert colors.tolist() == [[1, 0, 0.2], [0, 0, 0]]
