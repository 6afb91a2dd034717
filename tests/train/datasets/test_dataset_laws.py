"""Laws of every layout: camera axes, downscaling, undistortion and scene size."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.camera import orbit
from msdgs_train.datasets import Frame, SceneData, load_scene
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.images import write_png
from msdgs_train.datasets.common.normalization import OUTWARD_DISTANCE
from tests.support.tolerances import assert_close, tolerance
from tests.train.datasets import layouts
from tests.train.datasets.layouts import LAYOUTS, Layout, Pose, flat, pose
from tests.train.datasets.lens import Lens, centroids, frame_pixels, image_of_dots

IMAGES = {name: layout for name, layout in LAYOUTS.items() if name != "neu3d-videos"}
ONE_OF_EACH = {name: LAYOUTS[name] for name in ("dnerf", "neu3d", "neu3d-videos", "nerfstudio-pinhole")}
ONE_OF_EACH |= {name: LAYOUTS[name] for name in ("hypernerf-pinhole", "colmap-bin-PINHOLE")}
of_all = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
of_images = pytest.mark.parametrize("layout", IMAGES.values(), ids=IMAGES)
of_each = pytest.mark.parametrize("layout", ONE_OF_EACH.values(), ids=ONE_OF_EACH)


def frames_of(scene: SceneData) -> list[Frame]:
    return [frame for frames in scene.splits.values() for frame in frames]


def pose_of(frame: Frame) -> Pose:
    """The camera that a frame was written with: the first number in its name is that of the camera."""
    (number,) = re.findall(r"\d+", frame.name)[:1]
    return pose(int(number))


def is_pinhole(lens: Lens) -> bool:
    return lens == lens.pinhole()


@of_all
@pytest.mark.parametrize("reduction", [1, 2], ids=["whole", "half"])
def test_points_land_where_the_published_formula_puts_them(tmp_path: Path, layout: Layout, reduction: int):
    """Also for copies of half the stated size."""
    lens, frames = layout.lens, frames_of(load_scene(layout.write(tmp_path, layout.lens, reduction)))
    assert len(frames) >= 2
    for frame in frames:
        camera, points = frame.camera, pose_of(frame).to_world(lens.grid())
        assert (camera.width, camera.height) == (lens.width // reduction, lens.height // reduction)
        assert_close(frame_pixels(frame, points), lens.pixels(lens.grid()) / reduction, "pixel")
        assert (frame.distortion is None) == is_pinhole(lens)


@of_images
@pytest.mark.parametrize("size", [None, 160])
def test_dots_lie_at_their_pinhole_projections_after_loading(tmp_path: Path, layout: Layout, size: int | None):
    """A flipped axis, a transposed rotation, or distortion that is kept or removed twice would move them."""
    lens, folder = layout.lens, layout.write(tmp_path, layout.lens, 1)
    dots = image_of_dots(lens.pixels(lens.grid()), lens.width, lens.height)
    write_png(load_scene(folder).splits["train"][0].image_path, dots)
    frame = load_scene(folder, size).splits["train"][0]
    loaded, scale = frame.load_rgba(), (size or lens.width) / lens.width
    wanted = frame_pixels(replace(frame, distortion=None), pose_of(frame).to_world(lens.grid()))
    assert loaded.dtype == np.uint8
    assert loaded.shape == (frame.camera.height, frame.camera.width, 4)
    assert frame.camera.width == (size or lens.width)
    assert_close(centroids(loaded, wanted), wanted, "dot_centroid")
    assert_close(wanted, lens.pinhole().pixels(lens.grid()) * scale, "pixel")
    if not is_pinhole(lens):
        moved = np.abs(centroids(dots, lens.pixels(lens.grid())) * scale - wanted)
        assert moved.max() > 10 * tolerance("dot_centroid")


@of_images
def test_an_even_image_stays_even_up_to_its_corners(tmp_path: Path, layout: Layout):
    folder = layout.write(tmp_path, layout.lens, 1)
    rgba = np.dstack([flat([10, 200, 30], layout.lens), flat(128, layout.lens)[..., :1]])
    write_png(load_scene(folder).splits["train"][0].image_path, rgba)
    assert (load_scene(folder).splits["train"][0].load_rgba() == rgba).all()


@of_each
def test_a_size_is_at_most_the_width(tmp_path: Path, layout: Layout):
    folder, width = layout.write(tmp_path, layout.lens, 1), layout.lens.width
    whole, same = (load_scene(folder, size).splits["train"][0].load_rgba() for size in (None, width))
    assert (whole == same).all()
    for size in (0, -3, width + 1):
        with pytest.raises(InvalidInput, match="`size` must be") as caught:
            load_scene(folder, size)
        assert caught.value.field == "size"


AT_0 = {id_: {"time_id": 0} for id_ in layouts.HYPERNERF_IDS}
UNTIMED = layouts.dnerf_json()
for each in UNTIMED["frames"]:
    del each["time"]
STATIC: dict[str, Callable[[Path], Path]] = {
    "dnerf": lambda folder: layouts.write_dnerf(folder, splits={"train": UNTIMED}),
    "nerfstudio": layouts.write_nerfstudio,
    "hypernerf": lambda folder: layouts.write_hypernerf(
        folder, files={**layouts.hypernerf_json(), "metadata.json": AT_0}
    ),
    "neu3d": lambda folder: layouts.write_neu3d(folder, count=1),
    "colmap": lambda folder: layouts.write_colmap(folder, names=("c1/0005.png", "c2/0005.png")),
}


@pytest.mark.parametrize("write", STATIC.values(), ids=STATIC)
def test_a_scene_without_times_or_of_one_time_is_static(tmp_path: Path, write: Callable[[Path], Path]):
    scene = load_scene(write(tmp_path))
    assert scene.time_range == (0.0, 0.0)
    assert {frame.t for frame in scene.splits["train"]} == {0.0}


def cameras_around(target: tuple[float, float, float]) -> list[Camera]:
    """Cameras on a ring of radius 4 that look at the target."""
    poses = [orbit(np.array(target), 4.0, azimuth, 37.0, np.array([0.0, 0.0, 1.0])) for azimuth in range(0, 360, 30)]
    return [Camera.from_fov(pose, 20, 10, 40.0) for pose in poses]


def test_a_few_outlying_points_have_no_effect():
    points = np.random.default_rng(0).uniform(-1, 1, size=(1000, 3))
    clean = scene_half_size(points, cameras_around((0, 0, 0)))
    points[:5] *= 1e6
    assert 0.9 < clean < scene_half_size(points, []) < 1.0


def test_without_points_it_is_the_distance_to_where_all_cameras_look():
    assert_close(scene_half_size(None, cameras_around((0, 0, 0))), 4.0, "rotation")
    assert_close(scene_half_size(np.empty((0, 3)), cameras_around((3, -5, 1))), 9.0, "rotation")


@pytest.mark.parametrize("count", [1, 3])
def test_parallel_axes_have_no_intersection(count: int):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 2.0 * np.arange(count)
    extent = scene_half_size(None, [Camera.from_fov(pose, 20, 10, 40.0) for pose in poses])
    assert extent == (2.0 + 2.0 * OUTWARD_DISTANCE if count == 3 else 1.0)
