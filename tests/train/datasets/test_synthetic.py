"""The synthetic scene: its images agree with its known motion, and its folder is complete or missing."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV
from msdgs_train.datasets import Frame, SceneData, load_scene
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.datasets.synthetic.motion import GROUND_Z, OBJECTS, motion_at, world_positions
from msdgs_train.datasets.synthetic.rendering import NO_OBJECT, first_hit
from msdgs_train.datasets.synthetic.shapes import distance_at_rest
from msdgs_train.datasets.synthetic.trajectories import surface_colors, surface_points
from tests.support.tolerances import assert_close, tolerance

STILL, MOVING = ("ground", "frame"), ("ball", "ring", "jelly", "pendulum")
TIMES = np.linspace(0, 1, 41)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "scene"
    generate(out, size=96, train_frames=6, test_frames=2, seed=3)
    return out


@pytest.fixture(scope="module")
def scene(folder: Path) -> SceneData:
    return load_scene(folder)


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def chromaticity(rgb: np.ndarray) -> np.ndarray:
    return rgb / np.maximum(rgb.sum(axis=-1, keepdims=True), 1e-6)


def distances_along_rays(frame: Frame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From the camera: to each point, and to the first surface on the way there."""
    rays = points - frame.camera.position
    lengths = np.linalg.norm(rays, axis=1)
    motion, origin = motion_at(frame.t), tuple(map(float, frame.camera.position))
    hits = [first_hit(motion, *origin, *map(float, ray)) for ray in rays / lengths[:, None]]
    return lengths, np.array([distance if shape != NO_OBJECT else np.inf for distance, shape in hits])


def visible_points(frame: Frame, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """World positions and surface colors of material points that the frame's camera sees, inside their patterns."""
    positions, colors = [], []
    for name in ("ground", *MOVING):
        local = surface_points(name, count, seed=1)
        colors_here = surface_colors(name, local)
        nearby = [local + step for step in (*0.03 * np.eye(3), *-0.03 * np.eye(3))]
        inside = np.all([surface_colors(name, points) == colors_here for points in nearby], axis=(0, 2))
        local = local[inside]
        points = world_positions(name, local, frame.t)
        lengths, hits = distances_along_rays(frame, points)
        seen = np.abs(hits - lengths) < tolerance("ray_hit")
        positions.append(points[seen])
        colors.append(surface_colors(name, local[seen]))
    return np.concatenate(positions), np.concatenate(colors)


def interpolated(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values of [H, W, C] at [N, 2] positions (x, y); pixel (row 0, column 0) has its centre at (0.5, 0.5)."""
    at = pixels[:, ::-1].T - 0.5
    return np.stack([map_coordinates(channel, at, order=1, mode="nearest") for channel in np.moveaxis(image, 2, 0)], 1)


def color_errors(
    frame: Frame, t: float | None = None, pose: np.ndarray | None = None, shift: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Differences in chromaticity between material points and the image at their projection.

    The points are those visible from the frame's own camera at time `t`; they are projected from `pose`.
    """
    positions, colors = visible_points(frame if t is None else replace(frame, t=t))
    camera = frame.camera if pose is None else replace(frame.camera, camera_to_world=pose)
    rgba = frame.load_rgba() / 255.0
    image = linear(rgba[..., :3]) * rgba[..., 3:] + 1 - rgba[..., 3:]
    seen = chromaticity(interpolated(image, camera.project(positions)[0] + shift))
    return np.abs(seen - chromaticity(linear(colors))).sum(axis=1)


def share_that_fits(errors: list[np.ndarray]) -> float:
    return float((np.concatenate(errors) < 0.2).mean())


@pytest.mark.slow
def test_images_show_material_points_where_the_motion_puts_them(scene: SceneData):
    """Points that don't fit are at edges of objects. With wrong axes or times half as many fit, by chance."""
    frames = [*scene.splits["train"], *scene.splits["test"]]
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert share_that_fits([color_errors(frame) for frame in frames]) > 0.75
    wrong = {
        "OpenGL axes": [color_errors(f, pose=f.camera.camera_to_world @ OPENGL_TO_OPENCV) for f in frames],
        "upside down": [color_errors(f, pose=f.camera.camera_to_world @ half_turn) for f in frames],
        "from behind": [color_errors(f, pose=half_turn @ f.camera.camera_to_world) for f in frames],
        "too late": [color_errors(f, t=f.t + 0.1) for f in frames],
    }
    for name, errors in wrong.items():
        assert share_that_fits(errors) < 0.55, name


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_images_have_no_subpixel_offset(scene: SceneData, axis: int):
    shifts = np.linspace(-1, 1, 5)
    errors = [
        np.concatenate([color_errors(frame, shift=tuple(shift * np.eye(2)[axis])) for frame in scene.splits["train"]])
        for shift in shifts
    ]
    square, slope, _ = np.polyfit(shifts, np.mean(errors, axis=1), 2)
    assert abs(-slope / (2 * square)) < tolerance("image_offset")


@pytest.mark.parametrize("name", OBJECTS)
def test_every_material_point_stops_the_ray_to_it(scene: SceneData, name: str):
    """Rays use the inverse of the motion, points the motion itself."""
    local = surface_points(name, 200)
    for frame in scene.splits["train"]:
        lengths, hits = distances_along_rays(frame, world_positions(name, local, frame.t))
        assert (hits - lengths).max() < tolerance("ray_hit")
        assert (np.abs(hits - lengths) < tolerance("ray_hit")).sum() > 20


def test_several_objects_move_and_two_are_static():
    for name in OBJECTS:
        local = surface_points(name, 20)
        paths = np.stack([world_positions(name, local, t) for t in TIMES])
        travelled = np.linalg.norm(np.diff(paths, axis=0), axis=-1).sum(axis=0)
        assert (travelled == 0).all() if name in STILL else (travelled.mean() > 0.5)


@pytest.mark.parametrize("name", MOVING)
def test_motion_is_continuous(name: str):
    """Halving the time step halves the displacement, also at contact with the ground."""
    local = surface_points(name, 20)
    farthest = [
        np.linalg.norm(np.diff([world_positions(name, local, t) for t in np.linspace(0, 1, n)], axis=0), axis=-1).max()
        for n in (601, 1201)
    ]
    assert 0.45 < farthest[1] / farthest[0] < 0.55


@pytest.mark.parametrize("name", ["ring", "pendulum"])
def test_rigid_things_keep_their_distances(name: str):
    local = surface_points(name, 30)
    for t in TIMES:
        moved = world_positions(name, local, t)
        got, want = (np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (moved, local))
        assert_close(got, want, "rotation")


@pytest.mark.parametrize("name", ["ball", "jelly"])
def test_elastic_things_change_shape_and_keep_their_volume(name: str):
    index = OBJECTS.index(name)
    matrices = np.stack([motion_at(t).matrices[index] for t in TIMES])
    assert_close(np.linalg.det(matrices), np.ones(len(TIMES)), "rotation")
    stretches = np.linalg.svd(matrices, compute_uv=False)
    assert stretches[:, 0].max() > 1.15


def test_the_ball_touches_the_ground_and_does_not_enter_it():
    local = surface_points("ball", 2000)
    lowest = np.array([world_positions("ball", local, t)[:, 2].min() for t in np.linspace(0, 1, 301)]) - GROUND_Z
    assert lowest.min() > -tolerance("ray_hit")
    assert (lowest < 0.01).any()
    assert lowest.max() > 0.4


def test_objects_do_not_intersect():
    for t in TIMES:
        motion = motion_at(t)
        for name, other in combinations(MOVING, 2):
            points = world_positions(name, surface_points(name, 100), t)
            row = OBJECTS.index(other)
            if (motion.warps[row] != 0).any():
                gaps = np.linalg.norm(points - motion.centers[row], axis=1) - motion.radii[row]
            else:
                local = (points - motion.offsets[row]) @ motion.inverses[row].T
                gaps = np.array([distance_at_rest(row, *p) for p in local])
            assert gaps.min() > 0, (name, other, t)


def test_everything_is_in_the_initial_cube_of_training(scene: SceneData):
    for name in OBJECTS:
        for t in TIMES:
            assert np.abs(world_positions(name, surface_points(name, 100), t)).max() < scene.scene_half_size


def test_layout(folder: Path, scene: SceneData):
    assert {split: len(frames) for split, frames in scene.splits.items()} == {"train": 6, "val": 0, "test": 2}
    assert scene.time_range == (0.0, 1.0)
    assert [frame.t for frame in scene.splits["test"]] == [0.25, 0.75]
    assert not {frame.t for frame in scene.splits["train"]} & {frame.t for frame in scene.splits["test"]}
    for frame in scene.splits["train"]:
        rgba = frame.load_rgba()
        assert rgba.shape == (96, 96, 4)
        assert {0, 255} < set(rgba[..., 3].flat)
        assert (rgba[rgba[..., 3] == 0] == 0).all()
        assert np.linalg.norm(frame.camera.position) == pytest.approx(4.0)
        assert frame.camera.position[2] > 0
        assert frame.camera.fx == pytest.approx(48 / np.tan(0.345))
    assert (folder / "contact_sheet.png").exists()


def test_fixed_cameras_see_each_time_together(tmp_path: Path):
    generate(tmp_path / "a", size=8, train_frames=3, test_frames=1, cameras=2)
    frames = load_scene(tmp_path / "a").splits["train"]
    assert [frame.t for frame in frames] == [0, 0, 0.5, 0.5, 1, 1]
    positions = np.array([frame.camera.position for frame in frames]).reshape(3, 2, 3)
    assert_close(positions, np.broadcast_to(positions[:1], positions.shape), "rotation")
    assert np.linalg.norm(positions[0, 0] - positions[0, 1]) > 1


def test_written_trajectories_are_the_motion(folder: Path):
    content = json.loads((folder / "trajectories.json").read_text())
    assert {point["object"] for point in content["points"]} == set(OBJECTS)
    for point in content["points"][::7]:
        positions = [world_positions(point["object"], point["local"], t) for t in content["times"]]
        assert_close(point["positions"], positions, "material_point")
        assert point["color"] in surface_colors(point["object"], np.array([point["local"]])).tolist()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    generate(tmp_path / "a", size=24, train_frames=2, test_frames=1, seed=5)
    monkeypatch.setenv("MSDGS_THREADS", "1")
    generate(tmp_path / "b", size=24, train_frames=2, test_frames=1, seed=5)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_another_seed_gives_other_cameras_and_the_same_motion(tmp_path: Path):
    for seed in (0, 1):
        generate(tmp_path / str(seed), size=8, train_frames=2, test_frames=1, seed=seed)
    first, second = (load_scene(tmp_path / str(seed)).splits["train"] for seed in (0, 1))
    assert [frame.t for frame in first] == [frame.t for frame in second]
    assert np.abs(first[0].camera.position - second[0].camera.position).max() > 0.1


def test_progress_counts_every_image(tmp_path: Path):
    heard: list[tuple[int, int]] = []
    generate(tmp_path / "a", size=8, train_frames=3, test_frames=1, progress=lambda done, of: heard.append((done, of)))
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]


def interrupt(done: int, total: int) -> None:
    if done == 2:
        raise KeyboardInterrupt


def test_an_interrupted_generation_leaves_nothing_or_an_earlier_one_whole(tmp_path: Path):
    def begin() -> None:
        with pytest.raises(KeyboardInterrupt):
            generate(tmp_path / "a", size=12, train_frames=3, test_frames=1, progress=interrupt)

    begin()
    assert list(tmp_path.iterdir()) == []
    generate(tmp_path / "a", size=8, train_frames=2, test_frames=1)
    before = contents(tmp_path)
    begin()
    assert contents(tmp_path) == before
    generate(tmp_path / "a", size=12, train_frames=3, test_frames=0)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    scene = load_scene(tmp_path / "a")
    assert [len(scene.splits[split]) for split in ("train", "test")] == [3, 0]
    assert scene.splits["train"][0].camera.width == 12


def test_an_empty_folder_is_filled_but_foreign_folders_and_files_are_not_replaced(tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    generate(tmp_path / "empty", size=8, train_frames=1, test_frames=0)
    for name in ("mine", "file"):
        with pytest.raises(InvalidInput, match="`out` must be a new or empty folder"):
            generate(tmp_path / name, size=8, train_frames=1, test_frames=0)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize(
    "numbers", [{"size": 0}, {"size": 5000}, {"train_frames": 0}, {"test_frames": -1}, {"seed": -1}, {"seed": 2**31}]
)
def test_invalid_numbers_are_refused(tmp_path: Path, numbers: dict[str, Any]):
    with pytest.raises(InvalidInput) as caught:
        generate(tmp_path / "a", **numbers)
    assert caught.value.field in numbers
    assert not (tmp_path / "a").exists()
