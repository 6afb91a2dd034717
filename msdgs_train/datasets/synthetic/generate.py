"""A small synthetic moving scene, ray-marched into D-NeRF layout, with exactly known motion.

On a static, tiled ground a ball bounces fast and is squashed at contact, a striped ring tumbles, a dotted jelly
squashes, twists and bends, and a pendulum on a thin rod swings in a frame of thin bars. As in D-NeRF there is one image
per time, each from another camera, or fixed cameras all see each time. The same arguments give the same bytes.
"""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV, orbit
from msdgs_serve.writing import temporary_folder
from msdgs_train.datasets.common.images import composite, resize_area, write_png
from msdgs_train.datasets.synthetic.rendering import render
from msdgs_train.datasets.synthetic.trajectories import trajectories
from msdgs_train.settings import require_seed

CAMERA_ANGLE_X = 0.69  # radians
CAMERA_DISTANCE = 4.0
LOWEST, HIGHEST = 6.0, 75.0  # elevation of training cameras, degrees
TEST_ELEVATION = 25.0
R2_SEQUENCE = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence (M. Roberts, 2018), which cover azimuth and elevation evenly."""

MAX_SIZE = 4096
TRAJECTORIES = "trajectories.json"
TRAJECTORY_TIMES = 51
POINTS_PER_OBJECT = 24
CONTACT_SHEET = "contact_sheet.png"
CONTACT_SIZE, CONTACT_COLUMNS, CONTACT_ROWS = 128, 6, 4


class View(NamedTuple):
    """A camera and a time to render."""

    name: str
    camera: Camera
    t: float


def generate(
    out: Path | str,
    *,
    size: int = 128,
    train_frames: int = 64,
    test_frames: int = 12,
    cameras: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Make the dataset in folder `out`: images, transforms_{train,test}.json, trajectories.json, a contact sheet.

    The dataset is built beside `out` and moved there when complete; an interrupted call leaves `out` unchanged. An
    earlier dataset of this function is replaced, any other content is refused with `InvalidInput`.

    The arguments are the options of `msdgs-train synthetic`; `progress` is called with (done, total) after every image.
    """
    for name, value, least in (
        ("train_frames", train_frames, 1),
        ("test_frames", test_frames, 0),
        ("cameras", cameras, 1),
    ):
        if value is not None and value < least:
            raise InvalidInput(name, f"{least} or more", value)
    if not 1 <= size <= MAX_SIZE:
        raise InvalidInput("size", f"in [1, {MAX_SIZE}] pixels", size)
    require_seed("seed", seed)
    train = rig_views(train_frames, cameras, size, seed) if cameras else training_views(train_frames, size, seed)
    splits = {"train": train, "test": held_out_views(test_frames, size, seed)}
    total, done = len(train) + test_frames, 0
    thumbnails = []
    with _replaced_when_complete(Path(out)) as folder:
        for split, views in splits.items():
            (folder / split).mkdir()
            for view in views:
                rgba = render(view.camera, view.t)
                write_png(folder / split / f"{view.name}.png", rgba)
                thumbnails.append(_thumbnail(rgba))
                done += 1
                if progress is not None:
                    progress(done, total)
            _write_json(folder / f"transforms_{split}.json", _transforms(split, views))
        _write_json(folder / TRAJECTORIES, trajectories(POINTS_PER_OBJECT, np.linspace(0, 1, TRAJECTORY_TIMES), seed))
        write_png(folder / CONTACT_SHEET, _contact_sheet(thumbnails[: len(train)]))


def training_views(count: int, size: int, seed: int) -> list[View]:
    """Return one camera per time, over the upper hemisphere; successive cameras are far apart, as in D-NeRF."""
    azimuths, elevations = _directions(count, seed)
    return _views(size, azimuths, elevations, np.linspace(0, 1, count))


def rig_views(count: int, cameras: int, size: int, seed: int) -> list[View]:
    """Return `count` times, each seen by the same cameras over the upper hemisphere."""
    azimuths, elevations = _directions(cameras, seed)
    times = np.linspace(0, 1, count)
    return _views(size, np.tile(azimuths, count), np.tile(elevations, count), np.repeat(times, cameras))


def held_out_views(count: int, size: int, seed: int) -> list[View]:
    """Return cameras on one smooth turn around the scene, at the centers of `count` equal intervals of time."""
    parts = (np.arange(count) + 0.5) / max(count, 1)
    shift = np.random.default_rng(seed).uniform()
    return _views(size, 360 * (shift + parts), np.full(count, TEST_ELEVATION), parts)


def _directions(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths and elevations in degrees, even in area over the upper hemisphere."""
    shift = np.random.default_rng(seed).uniform(size=2)
    across, up = ((shift + np.arange(count)[:, None] * R2_SEQUENCE) % 1).T
    low, high = math.sin(math.radians(LOWEST)), math.sin(math.radians(HIGHEST))
    return 360 * across, np.degrees(np.arcsin(low + up * (high - low)))


def _views(size: int, azimuths: np.ndarray, elevations: np.ndarray, times: np.ndarray) -> list[View]:
    focal = 0.5 * size / math.tan(0.5 * CAMERA_ANGLE_X)
    target, up = np.zeros(3), np.array([0.0, 0.0, 1.0])
    views = []
    for index, (azimuth, elevation, t) in enumerate(zip(azimuths, elevations, times, strict=True)):
        pose = orbit(target, CAMERA_DISTANCE, float(azimuth), float(elevation), up)
        views.append(View(f"r_{index:03d}", Camera(focal, focal, size / 2, size / 2, size, size, pose), float(t)))
    return views


def _transforms(split: str, views: list[View]) -> dict[str, object]:
    frames = [
        {
            "file_path": f"./{split}/{view.name}",
            "time": view.t,
            "transform_matrix": (view.camera.camera_to_world @ OPENGL_TO_OPENCV).tolist(),
        }
        for view in views
    ]
    return {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")


def _thumbnail(rgba: np.ndarray) -> np.ndarray:
    side = min(CONTACT_SIZE, len(rgba))
    small = resize_area(rgba, side, side)
    return np.floor(255 * composite(small, (1.0, 1.0, 1.0)) + 0.5).astype(np.uint8)


def _contact_sheet(thumbnails: list[np.ndarray]) -> np.ndarray:
    """Arrange up to 24 evenly spaced images in rows."""
    count = min(len(thumbnails), CONTACT_COLUMNS * CONTACT_ROWS)
    chosen = [thumbnails[index * len(thumbnails) // count] for index in range(count)]
    columns = min(count, CONTACT_COLUMNS)
    chosen += [np.full_like(chosen[0], 255)] * (-count % columns)
    return np.concatenate([np.concatenate(chosen[i : i + columns], axis=1) for i in range(0, len(chosen), columns)])


@contextmanager
def _replaced_when_complete(out: Path) -> Iterator[Path]:
    """A folder beside `out`, which it replaces at the end of the block, unless an exception is raised."""
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / TRAJECTORIES).exists())):
        raise InvalidInput("out", "a new or empty folder, or a dataset made by this command", out)
    out = out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(out.parent, out) as temporary:
        new, old = temporary / "new", temporary / "old"
        new.mkdir()
        yield new
        if out.exists():
            out.rename(old)
        new.rename(out)
