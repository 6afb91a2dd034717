"""Poses of a clip of known truth, with and without masks of what moves, and the dataset that is made of them."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from msdgs_train.capture import sfm_process, views
from msdgs_train.capture.dataset import MOTION_MASKS, write_dataset
from msdgs_train.capture.errors import CaptureFailed
from msdgs_train.capture.fixed_cameras import is_fixed
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.frames import extract_frames
from msdgs_train.capture.image_files import read_color, read_gray, write_image
from msdgs_train.capture.moving import find_moving
from msdgs_train.capture.poses import Poses, find_poses
from msdgs_train.capture.verdict import MIN_AGREEMENT
from msdgs_train.datasets import SceneData, load_scene
from tests.support.clips import Clip, fixed_camera_clips, moving_camera_clip
from tests.support.tolerances import tolerance
from tests.support.training_scene import small_config, splatting, trained
from tests.train.capture.conftest import ARC, COUNT, Captured

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("captured")]
STEPS = 2


def worst_turn(clip: Clip, frames: FrameSet, poses: Poses) -> float:
    """The largest error in degrees of the rotation between two neighbours; no alignment has a part in it."""
    times = {frame.name: frame.time for frame in frames.frames}
    order = [int(np.abs(clip.times - times[name]).argmin()) for name in poses.registered]
    found, true = poses.summary.camera_to_world[:, :3, :3], clip.camera_to_world[order][:, :3, :3]
    steps = [turns[:-1].transpose(0, 2, 1) @ turns[1:] for turns in (found, true)]
    traces = np.einsum("nij,nij->n", *steps)
    return float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))).max())


def test_all_frames_have_poses_near_the_true_ones(captured: Captured):
    poses = Poses.load(captured.step("poses"), captured.frames)
    assert len(poses.registered) == len(captured.frames.frames) == COUNT
    assert worst_turn(captured.clip, captured.frames, poses) < tolerance("capture.turn")


def test_frames_that_are_not_in_the_model_are_registered_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(views, "KEYFRAMES", COUNT // 2)
    clip = moving_camera_clip(tmp_path / "clip.mp4", width=224, frames=COUNT, arc=ARC, poster=False)
    images, stages = tmp_path / "images", {}
    frames = extract_frames([clip.file], images)
    poses = find_poses(
        images, frames, tmp_path, threads=1, progress=lambda stage, _, total: stages.update({stage: total})
    )
    assert stages["mapping"] == stages["other frames"] == COUNT // 2
    assert len(poses.registered) == COUNT
    assert worst_turn(clip, frames, poses) < tolerance("capture.turn")
    observed = {poses.registered[image] for image in poses.summary.observations[:, 0]}
    assert observed == set(poses.registered)


def test_most_of_what_is_masked_moves_and_most_of_what_moves_is_masked(captured: Captured):
    masks = np.stack([read_gray(captured.found.masks / frame.name) > 0 for frame in captured.frames.frames])
    moving = captured.clip.moving
    assert moving.mean() > 1 / 3
    assert (masks & moving).sum() > masks.sum() / 2
    assert (masks & moving).sum() > moving.sum() / 2


def test_one_thread_and_seed_give_the_same_poses(captured: Captured, tmp_path: Path):
    poses = Poses.load(captured.step("poses"), captured.frames)
    again = find_poses(captured.images, captured.frames, tmp_path, threads=1)
    assert again.registered == poses.registered
    np.testing.assert_array_equal(again.summary.camera_to_world, poses.summary.camera_to_world)


def test_the_dataset_is_a_colmap_folder_with_the_times_of_the_frames(captured: Captured):
    scene = load_scene(captured.data)
    assert scene.layout == "COLMAP"
    assert scene.points is not None
    frames = scene.splits["train"] + scene.splits["test"]
    assert all(frame.distortion is None and frame.mask_path is None for frame in frames)
    times = {frame.name: frame.time for frame in captured.frames.frames}
    last = max(times.values())
    unit = max(last, 1.0)
    assert {frame.image_path.name: frame.t for frame in frames} == pytest.approx(
        {name: time / unit for name, time in times.items()}
    )
    program = "import pycolmap, sys; print(pycolmap.Reconstruction(sys.argv[1]).num_reg_images())"
    sparse = captured.data / "sparse" / "0"
    done = subprocess.run([sys.executable, "-c", program, sparse], capture_output=True, text=True, check=True)
    assert int(done.stdout) == COUNT


def test_undistorted_images_have_no_black_borders_and_masks_their_size(captured: Captured):
    for frame in captured.frames.frames:
        image = read_color(captured.data / "images" / frame.name)
        mask = read_gray(captured.data / MOTION_MASKS / frame.name)
        assert mask.shape == image.shape[:2]
        edges = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert np.median(edges.max(axis=1)) > 0


def test_nothing_that_is_written_has_a_path_or_metadata(captured: Captured):
    folders = [captured.data / name for name in ("images", MOTION_MASKS, "sparse")]
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file()]
    assert len(files) > 2 * COUNT
    for file in files:
        content = file.read_bytes()
        assert str(captured.data.parent).encode() not in content, file
        if file.suffix == ".png":
            assert not any(chunk in content for chunk in (b"tEXt", b"iTXt", b"zTXt", b"tIME", b"eXIf")), file
    times = json.loads((captured.data / "times.json").read_text(encoding="utf-8"))
    assert times["unit"] == "seconds"
    assert set(times["times"]) == {f"images/{frame.name}" for frame in captured.frames.frames}


def test_what_moves_is_in_the_loss(captured: Captured, tmp_path: Path):
    """Training differs if only the pixels that the motion masks show have another color."""
    painted = tmp_path / "painted"
    write_dataset(captured.images, captured.frames, captured.found.poses, captured.found.masks, painted)
    for frame in captured.frames.frames:
        image = read_color(painted / "images" / frame.name)
        image[read_gray(painted / MOTION_MASKS / frame.name) > 0] = (255, 0, 255)
        write_image(painted / "images" / frame.name, image)
    assert not torch.equal(colors(load_scene(captured.data, size=24)), colors(load_scene(painted, size=24)))


def colors(scene: SceneData) -> torch.Tensor:
    """Of the Gaussians after some steps."""
    return splatting(trained(small_config(), scene.normalized(), STEPS)).model.gaussians.sh_dc.detach().clone()


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Clip], Path, FrameSet, Poses]:
    folder = tmp_path_factory.mktemp("rig")
    clips = fixed_camera_clips(folder, width=256, frames=5, offsets=(0.0, 0.1, 0.2, 0.3))
    images = folder / "images"
    frames = extract_frames([clip.file for clip in clips], images, offsets=[clip.offset for clip in clips])
    return clips, images, frames, find_poses(images, frames, folder / "poses", threads=1)


def test_frames_of_a_fixed_camera_share_its_pose(rig: tuple[list[Clip], Path, FrameSet, Poses]):
    clips, _, frames, poses = rig
    assert poses.fixed == (True,) * len(clips)
    assert poses.registered == tuple(sorted(frame.name for frame in frames.frames))
    for camera in range(len(clips)):
        names = {frame.name for frame in frames.frames if frame.camera == camera}
        own = poses.summary.camera_to_world[[name in names for name in poses.registered]]
        assert len(own) == len(names) > 1
        assert (own == own[0]).all()


def test_right_poses_agree_with_what_frames_have_in_common(captured: Captured):
    assert 1.5 * MIN_AGREEMENT < captured.found.poses.summary.agreement < 2


def test_fixed_cameras_of_one_lens_share_its_intrinsics(rig: tuple[list[Clip], Path, FrameSet, Poses]):
    _, _, _, poses = rig
    assert (poses.summary.intrinsics == poses.summary.intrinsics[0]).all()


def test_fixed_cameras_of_two_lenses_keep_their_own(rig: tuple[list[Clip], Path, FrameSet, Poses], tmp_path: Path):
    _, images, frames, _ = rig
    for frame in frames.frames:
        image = read_color(images / frame.name)
        if frame.camera % 2:
            height, width = image.shape[:2]
            inner = image[height // 16 : -height // 16, width // 16 : -width // 16]
            image = cv2.resize(inner, (width, height), interpolation=cv2.INTER_CUBIC)
        write_image(tmp_path / frame.name, image)
    poses = find_poses(tmp_path, frames, tmp_path / "poses", threads=1)
    cameras = {frame.name: frame.camera for frame in frames.frames}
    focals = dict(zip((cameras[name] for name in poses.registered), poses.summary.intrinsics[:, 0], strict=True))
    wide, narrow = ([focal for camera, focal in focals.items() if camera % 2 == odd] for odd in (0, 1))
    assert len(wide) + len(narrow) >= 3
    assert np.mean(narrow) > 1.05 * np.mean(wide)


def test_fixed_cameras_mask_what_differs_from_their_background(
    rig: tuple[list[Clip], Path, FrameSet, Poses], tmp_path: Path
):
    clips, images, frames, poses = rig
    shares = find_moving(images, frames, poses, tmp_path)
    assert set(shares) == set(poses.registered)
    names = [frame.name for frame in frames.frames if frame.camera == 0]
    masks = np.stack([read_gray(tmp_path / name) > 0 for name in names])
    assert masks[clips[0].moving].mean() > 2 * masks[~clips[0].moving].mean()


def test_a_moving_camera_is_not_fixed(captured: Captured):
    assert not is_fixed([captured.images / frame.name for frame in captured.frames.frames])


def test_a_crash_of_colmap_is_an_error_that_names_the_folder(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sfm_process, "PROGRAM", "msdgs_train.capture.no_such_program")
    with pytest.raises(CaptureFailed, match=r"COLMAP ended with code 1: .*no_such_program") as failed:
        find_poses(captured.images, captured.frames, tmp_path, threads=1)
    assert failed.value.file == captured.images


def test_an_interrupted_search_ends_its_process(captured: Captured, tmp_path: Path):
    stages = []

    def interrupt(stage: str, done: int, total: int) -> None:
        stages.append((stage, done, total))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_poses(captured.images, captured.frames, tmp_path, threads=1, progress=interrupt)
    assert stages == [("features", 0, COUNT)]
    assert not (tmp_path / "geometry.npz").exists()


def test_images_of_one_color_have_no_poses(tmp_path: Path, captured: Captured):
    few = FrameSet(captured.frames.cameras, captured.frames.frames[:4])
    for shade, frame in enumerate(few.frames):
        write_image(tmp_path / "images" / frame.name, np.full((96, 128, 3), 60 * shade, np.uint8))
    poses = find_poses(tmp_path / "images", few, tmp_path / "poses", threads=1)
    assert poses.registered == ()
    with pytest.raises(CaptureFailed, match="no frame has a pose"):
        write_dataset(tmp_path / "images", few, poses, None, tmp_path / "data")


def test_opencv_reads_what_it_wrote(tmp_path: Path):
    picture = np.random.default_rng(0).integers(0, 256, (8, 9, 3), np.uint8)
    write_image(tmp_path / "a" / "b.png", picture)
    np.testing.assert_array_equal(read_color(tmp_path / "a" / "b.png"), picture)
    np.testing.assert_array_equal(
        read_gray(tmp_path / "a" / "b.png"), cv2.imread(str(tmp_path / "a" / "b.png"), cv2.IMREAD_GRAYSCALE)
    )
    (tmp_path / "c.png").write_bytes(b"")
    with pytest.raises(CaptureFailed, match=r"c\.png: is not an image"):
        read_color(tmp_path / "c.png")
