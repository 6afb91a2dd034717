"""A capture made by hand: frames as PNG, masks, and the exact model of a camera on an arc."""

from pathlib import Path

import numpy as np

from msdgs_train.capture.frame_set import CapturedCamera, CapturedFrame, FrameSet
from msdgs_train.capture.image_files import write_image
from msdgs_train.capture.poses import Poses
from msdgs_train.capture.sparse_model import Summary
from tests.support.camera_moves import TARGET, arc

FOCAL, WIDTH, HEIGHT = 100.0, 96, 64


def made_frames(count: int = 16, **properties: object) -> FrameSet:
    """Frames of one camera at 10 a second."""
    camera = CapturedCamera("", WIDTH, HEIGHT, (count - 1) / 10, 3 * count)
    frames = [CapturedFrame(f"{index:05d}.png", 0, index / 10, 1.0 + index) for index in range(count)]
    return FrameSet((camera,), tuple(frames), **properties)  # type: ignore[arg-type]


def write_images(frames: FrameSet, images: Path, masks: Path) -> None:
    """Random pictures, and masks whose left half moves."""
    random = np.random.default_rng(0)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    for frame in frames.frames:
        write_image(images / frame.name, random.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
        write_image(masks / frame.name, mask)


def made_model(frames: FrameSet, camera_to_world: list[np.ndarray] | None = None, points: int = 200) -> Summary:
    """Poses of all frames, on an arc of 40° if none are given, that see points of all depths."""
    poses = np.stack(camera_to_world or arc(40, len(frames.frames)))
    random = np.random.default_rng(0)
    positions = TARGET + random.uniform(-0.7, 0.7, (points, 3))
    seen = np.array([(image, point) for image in range(len(poses)) for point in range(points)], int).reshape(-1, 2)
    return Summary(
        names=np.array([frame.name for frame in frames.frames]),
        camera_to_world=poses,
        intrinsics=np.tile([FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], (len(poses), 1)),
        points=positions,
        colors=random.integers(0, 256, (points, 3), np.uint8),
        observations=seen,
        error=0.4,
        method="incremental",
        others=(5, 3),
        beyond_rotation=7.5,
        agreement=1.1,
    )


def made_poses(model: Summary) -> Poses:
    """The poses of a model of one moving camera."""
    return Poses(Path("sparse"), model, (False,))
