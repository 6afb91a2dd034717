"""Neu3D layout: cameras from LLFF's numbers, frames from videos and folders, and what is wrong with bad files."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import Interpolation

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common import video
from msdgs_train.datasets.common.images import resize_area, write_png
from tests.support.lens import frame_pixels
from tests.support.tolerances import assert_close, tolerance

WIDTH, HEIGHT, COUNT = 32, 24, 7
HWF = (4 * HEIGHT, 4 * WIDTH, 100.0)  # of the full size; what is stored is a quarter of it
ACCURATE = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INP


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "msdgs" / "videos"


def poses_bounds(count: int, seed: int = 0) -> np.ndarray:
    """[count, 17] cameras that are turned at random."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        axes *= np.sign(np.linalg.det(axes))  # down, right and back are right-handed, as right, up and back are
        matrix = np.column_stack([axes, rng.normal(size=3), HWF])
        rows.append([*matrix.ravel(), 0.5, 9.0])
    return np.array(rows)


def color(camera: int, index: int) -> np.ndarray:
    return (np.array([40 + 25 * index, 60 + 30 * camera, 200 - 20 * index]) % 256).astype(np.uint8)


def flat(camera: int, index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.full((height, width, 3), color(camera, index), np.uint8)


def write_video(path: Path, pictures: list[np.ndarray]) -> None:
    """Without loss but for chroma at half the size; later frames are stored before earlier ones, as usual."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=30, options={"crf": "0"})
        stream.height, stream.width, _ = pictures[0].shape
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", interpolation=ACCURATE)))
        container.mux(stream.encode())


def write_videos(folder: Path, cameras: int = 3, counts: tuple[int, ...] = ()) -> Path:
    np.save(folder / "poses_bounds.npy", poses_bounds(cameras))
    for camera in range(cameras):
        count = counts[camera] if counts else COUNT
        write_video(folder / f"cam{camera:02d}.mp4", [flat(camera, index) for index in range(count)])
    return folder


def write_images(folder: Path, names: tuple[str, ...] = ("cam00", "cam01"), count: int = 3, below: str = "") -> Path:
    np.save(folder / "poses_bounds.npy", poses_bounds(len(names)))
    for camera, name in enumerate(names):
        (folder / name / below).mkdir(parents=True)
        for index in range(count):
            write_png(folder / name / below / f"{index:04d}.png", flat(camera, index))
    return folder


def llff_pixel(row: np.ndarray, point: np.ndarray) -> np.ndarray:
    """LLFF's own reading in pixels of the full size: right, up, back = column 1, minus column 0, column 2."""
    matrix = row[:15].reshape(3, 5)
    down, right, back, position = matrix[:, 0], matrix[:, 1], matrix[:, 2], matrix[:, 3]
    height, width, focal = matrix[:, 4]
    offset = point - position
    x, y, z = offset @ right, offset @ -down, offset @ back
    return np.array([width / 2 - focal * x / z, height / 2 + focal * y / z])


@pytest.mark.parametrize("write", [write_videos, write_images])
def test_points_land_where_the_published_formula_puts_them(tmp_path: Path, write: Callable[[Path], Path]):
    scene = load_scene(write(tmp_path))
    rng = np.random.default_rng(1)
    for frame in [*scene.splits["train"], *scene.splits["test"]]:
        row = np.load(tmp_path / "poses_bounds.npy")[int(frame.name[3:5])]
        back, position = row[:15].reshape(3, 5)[:, [2, 3]].T
        points = position - 3 * back + rng.uniform(-1, 1, size=(10, 3))
        want = np.array([llff_pixel(row, point) / 4 for point in points])
        assert_close(frame_pixels(frame, points), want, "pixel")


def test_splits_times_and_pixels_of_videos(tmp_path: Path):
    scene = load_scene(write_videos(tmp_path))
    assert {split: len(frames) for split, frames in scene.splits.items()} == {
        "train": 2 * COUNT,
        "val": 0,
        "test": COUNT,
    }
    assert scene.time_range == (0.0, 1.0)
    assert len({frame.image_path for frame in scene.splits["train"]}) == 2 * COUNT
    order = np.random.default_rng(0).permutation(2 * COUNT)
    for number in order:
        frame, camera, index = scene.splits["train"][number], 1 + number // COUNT, number % COUNT
        assert (frame.name, frame.t) == (f"cam{camera:02d}_{index:06d}", index / (COUNT - 1))
        rgba = frame.load_rgba()
        assert rgba.shape == (HEIGHT, WIDTH, 4)
        assert (rgba[..., 3] == 255).all()
        assert_close(rgba[..., :3].astype(float), flat(camera, index).astype(float), "video_color")


def test_splits_times_and_pixels_of_folders(tmp_path: Path):
    scene = load_scene(write_images(tmp_path, below="images"))
    assert [frame.t for frame in scene.splits["train"]] == [0.0, 0.5, 1.0]
    for camera, split in enumerate(("test", "train")):
        for index, frame in enumerate(scene.splits[split]):
            assert frame.name == f"cam{camera:02d}_{index:04d}"
            assert (frame.load_rgba()[..., :3] == flat(camera, index)).all()


def test_a_camera_may_be_left_out_and_numbers_need_no_zeros(tmp_path: Path):
    """Rows follow the names by number: cam2 comes before cam10, and frame 2 before frame 10."""
    write_images(tmp_path, names=("cam00", "cam2", "cam10"), count=1)
    for index in (10, 2):
        write_png(tmp_path / "cam00" / f"{index}.png", flat(0, index))
        write_png(tmp_path / "cam2" / f"{index}.png", flat(1, index))
        write_png(tmp_path / "cam10" / f"{index}.png", flat(2, index))
    scene = load_scene(tmp_path)
    poses = np.load(tmp_path / "poses_bounds.npy")
    assert [frame.name for frame in scene.splits["test"]] == ["cam00_0000", "cam00_2", "cam00_10"]
    assert [frame.name[:5] for frame in scene.splits["train"][::3]] == ["cam2_", "cam10"]
    for row, frame in zip(poses[1:], scene.splits["train"][::3], strict=True):
        assert (frame.camera.position == row[[3, 8, 13]]).all()


def test_a_single_frame_is_static(tmp_path: Path):
    scene = load_scene(write_images(tmp_path, count=1))
    assert scene.time_range == (0.0, 0.0)


def waves(width: int, height: int) -> np.ndarray:
    """Color changes downwards only: where chroma lies across is another matter in H.264 than in FFmpeg's encoding."""
    y, x = np.mgrid[0:height, 0:width]
    grey = 128 + 40 * np.sin(x / 9) * np.cos(y / 7)
    return np.stack([grey + 40 * np.sin(y / 6), grey, grey + 40 * np.cos(y / 5)], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("size", [160, 80, 40, 67])
def test_size_reduces_a_video_as_it_does_images(tmp_path: Path, size: int):
    pictures = [waves(160, 120), waves(160, 120)[::-1]]
    for name in ("cam00", "cam01"):
        write_video(tmp_path / f"{name}.mp4", pictures)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(2))
    for frame, picture in zip(load_scene(tmp_path, size).splits["train"], pictures, strict=True):
        rgba = np.dstack([picture, np.full((120, 160), 255, np.uint8)])
        want = resize_area(rgba, size, round(size * 0.75))[..., :3].astype(float)
        assert np.abs(frame.load_rgba()[..., :3] - want).mean() < tolerance("video_picture.mean")


def test_the_color_matrix_is_the_one_that_the_video_names(tmp_path: Path):
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(2))
    for camera, (name, number) in enumerate((("ITU601", 5), ("ITU709", 1))):
        with av.open(str(tmp_path / f"cam0{camera}.mp4"), "w") as container:
            stream: Any = container.add_stream("libx264", rate=30, options={"crf": "0"})
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            stream.codec_context.colorspace = number
            picture = av.VideoFrame.from_ndarray(flat(0, 3), format="rgb24")
            container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace=name)))
            container.mux(stream.encode())
    scene = load_scene(tmp_path)
    for split in ("train", "test"):
        assert_close(
            scene.splits[split][0].load_rgba()[0, 0, :3].astype(float), color(0, 3).astype(float), "video_color"
        )


def test_a_video_is_decoded_once_for_all_runs(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    first = load_scene(write_videos(tmp_path)).splits["test"]
    pixels = [frame.load_rgba() for frame in first]
    (file,) = cache.iterdir()
    monkeypatch.setattr(video, "_decoded", lambda *_: pytest.fail("decoded again"))
    again = load_scene(tmp_path).splits["test"]
    assert all((frame.load_rgba() == known).all() for frame, known in zip(again, pixels, strict=True))
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file.write_bytes(file.read_bytes()[:-1])  # as after a crash
    assert (first[2].load_rgba() == pixels[2]).all()
    write_video(tmp_path / "cam00.mp4", [flat(4, index) for index in range(COUNT)])
    changed = load_scene(tmp_path).splits["test"][0].load_rgba()
    assert_close(changed[..., :3].astype(float), flat(4, 0).astype(float), "video_color")


def test_a_cache_that_cant_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "occupied").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "occupied"))
    frame = load_scene(write_videos(tmp_path)).splits["test"][0]
    with pytest.raises(DatasetInvalid, match=r"cam00\.mp4: `video` can't be stored decoded in .*XDG_CACHE_HOME"):
        frame.load_rgba()


def test_a_video_that_is_cut_off_is_refused_and_leaves_nothing(tmp_path: Path, cache: Path):
    """The header comes first and says how many frames there should be."""
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(2))
    noise = np.random.default_rng(0).integers(0, 256, size=(COUNT, 96, 128, 3), dtype=np.uint8)
    for name in ("cam00", "cam01"):
        with av.open(str(tmp_path / f"{name}.mp4"), "w", options={"movflags": "faststart"}) as container:
            stream: Any = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
            for picture in noise:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    path = tmp_path / "cam01.mp4"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frame = load_scene(tmp_path).splits["train"][0]
    with pytest.raises(DatasetInvalid, match=r"cam01\.mp4: `video` (has 7 frames by its header, but|can't be decoded)"):
        frame.load_rgba()
    assert not list(cache.iterdir())


def test_without_pyav_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_videos(tmp_path)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(DatasetInvalid, match=r"`video` needs av to be read: pip install 'msdgs\[train\]'"):
        load_scene(tmp_path)


def test_points_beside_the_poses(tmp_path: Path):
    write_images(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
    tail = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "points3D_downsample.ply").write_text("no points")
    (tmp_path / "points3D_downsample2.ply").write_text(header + tail + "1 2 3 255 0 51\n-0.5 0 0 0 0 0\n")
    scene = load_scene(tmp_path)
    assert scene.points is not None
    assert scene.point_colors is not None
    assert scene.points.tolist() == [[1, 2, 3], [-0.5, 0, 0]]
    assert scene.point_colors.tolist() == [[1, 0, 0.2], [0, 0, 0]]


def test_a_static_scene_of_llff_is_none_of_this_layout(tmp_path: Path):
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(3))
    with pytest.raises(DatasetInvalid, match="is in no known layout"):
        load_scene(tmp_path)


def changed(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(poses: np.ndarray) -> np.ndarray:
        poses = poses.copy()
        poses[row, column] = value
        return poses

    return change


WRONG = [
    (lambda poses: poses[:, :15], "file", "must hold real numbers in shape M×17"),
    (lambda poses: poses.astype(str), "file", "must hold real numbers in shape M×17"),
    (lambda poses: poses[:1], "rows", "are 1, but there are 2 cameras: cam00 cam01"),
    (lambda poses: np.tile(poses, (2, 1)), "rows", "are 4, but there are 2 cameras"),
    (changed(1, 3, np.nan), "row 1", "must be finite"),
    (changed(0, 16, np.inf), "row 0", "must be finite"),
    (changed(1, 15, -1.0), "row 1", "must end in 0 < near < far, got -1 and 9"),
    (changed(1, 16, 0.1), "row 1", "must end in 0 < near < far, got 0.5 and 0.1"),
    (changed(1, 4, 1000.0), "row 1", "states a size of 128×1000, but the image is 32×24"),
    (changed(1, 4, -96.0), "row 1", "states a size of 128×-96"),
    (changed(1, 14, 0.0), "row 1", "above 0 pixels, got 0"),
    (changed(1, 0, 5.0), "row 1", "without scale or mirroring"),
]


@pytest.mark.parametrize(("change", "field", "problem"), WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_with_poses_is_named(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], field: str, problem: str
):
    file = write_images(tmp_path) / "poses_bounds.npy"
    np.save(file, change(np.load(file)))
    with pytest.raises(DatasetInvalid) as caught:
        load_scene(tmp_path)
    assert (caught.value.file, caught.value.field) == (str(file), field)
    assert problem in str(caught.value)


@pytest.mark.parametrize("content", [None, b"", b"not numpy", b"PK\x03\x04"])
def test_poses_that_are_missing_or_no_array(tmp_path: Path, content: bytes | None):
    file = write_images(tmp_path) / "poses_bounds.npy"
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(DatasetInvalid, match=r"poses_bounds\.npy: `file` (can't be read|is not a NumPy array)"):
        load_scene(tmp_path)


def test_cameras_out_of_step_are_refused(tmp_path: Path):
    write_videos(tmp_path, cameras=2, counts=(5, 4))
    with pytest.raises(DatasetInvalid, match=r"cam01\.mp4: `frames` are 4, but .*cam00\.mp4 has 5"):
        load_scene(tmp_path)


def test_images_of_a_camera_have_one_size(tmp_path: Path):
    write_images(tmp_path)
    write_png(tmp_path / "cam01" / "0002.png", flat(0, 0, 8, 6))
    with pytest.raises(DatasetInvalid, match=r"0002\.png: `image` is 8×6, but .*0000\.png is 32×24"):
        load_scene(tmp_path)


def test_a_camera_without_images_is_named(tmp_path: Path):
    write_images(tmp_path)
    (tmp_path / "cam02").mkdir()
    with pytest.raises(DatasetInvalid, match=r"cam02: `frames` are missing: there is no cam02\.mp4"):
        load_scene(tmp_path)


def test_one_camera_is_not_enough(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match="`cameras` must be two or more, got 1"):
        load_scene(write_images(tmp_path, names=("cam00",)))


def test_what_is_no_video_is_refused(tmp_path: Path):
    write_videos(tmp_path, cameras=2)
    (tmp_path / "cam01.mp4").write_bytes(b"not a video")
    with pytest.raises(DatasetInvalid, match=r"cam01\.mp4: `video` can't be read: "):
        load_scene(tmp_path)


@pytest.mark.parametrize("size", [0, -1, WIDTH + 1])
@pytest.mark.parametrize("write", [write_videos, write_images])
def test_sizes_that_cant_be(tmp_path: Path, write: Callable[[Path], Path], size: int):
    with pytest.raises(InvalidInput, match="`size` must be"):
        load_scene(write(tmp_path), size)
