"""Small datasets of each layout, written from known cameras in the conventions of the format."""

import json
import math
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.video.reformatter import Interpolation

from msdgs_train.datasets import SceneData
from msdgs_train.datasets.common.images import write_png
from tests.support.reference import quaternion_matrix
from tests.train.datasets.lens import Lens

ACCURATE = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INP
OPENGL = np.diag([1.0, -1.0, -1.0])
CENTERED = Lens(fx=300.0, fy=300.0, cx=160.0, cy=120.0)
SMALL = Lens(fx=30.0, fy=30.0, cx=16.0, cy=12.0, width=32, height=24)
LENSES = {
    "pinhole": Lens(),
    "barrel": Lens(k1=-0.2, k2=0.05, p1=0.002, p2=-0.003, k3=-0.01),
    "pincushion": Lens(k1=0.08, k2=0.02, p1=-0.001, p2=0.002),
    "tangential": Lens(p1=0.01, p2=-0.006),
}


class Pose(NamedTuple):
    """A camera: its rotation as a unit quaternion wxyz, camera to world in OpenCV axes, and its position [3]."""

    q: np.ndarray
    position: np.ndarray

    @property
    def rotation(self) -> np.ndarray:
        """[3, 3]; its columns are right, down and forward."""
        return quaternion_matrix(self.q)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] points in camera axes."""
        return points @ self.rotation.T + self.position


def pose(index: int) -> Pose:
    rng = np.random.default_rng(index)
    q = rng.normal(size=4)
    return Pose(q / np.linalg.norm(q), rng.normal(size=3))


def flat(color: Any, lens: Lens, reduction: int = 1) -> np.ndarray:
    """[H, W, 3] of one color."""
    return np.full((lens.height // reduction, lens.width // reduction, 3), color, np.uint8)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image and create its folder; an existing image is kept."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        write_png(path, image)


def points_of(scene: SceneData) -> tuple[list[list[float]], np.ndarray]:
    """The sparse points and their colors, which must exist."""
    assert scene.points is not None
    assert scene.point_colors is not None
    return scene.points.tolist(), scene.point_colors


# NeRF's JSON, of D-NeRF and nerfstudio: camera to world in OpenGL axes, which are right, up and back


def opengl_matrix(of: Pose) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = of.rotation @ OPENGL, of.position
    return matrix.tolist()


def intrinsics(lens: Lens) -> dict[str, Any]:
    values = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height}
    return {**values, **{key: getattr(lens, key) for key in ("k1", "k2", "p1", "p2", "k3")}}


def dnerf_json(split: str = "train", times: tuple[float, ...] = (0.0, 1.0), lens: Lens = CENTERED) -> dict[str, Any]:
    frames = [
        {"file_path": f"./{split}/r_{index}", "time": t, "transform_matrix": opengl_matrix(pose(index))}
        for index, t in enumerate(times)
    ]
    return {"camera_angle_x": 2 * math.atan(0.5 * lens.width / lens.fx), "frames": frames}


def write_dnerf(
    folder: Path, lens: Lens = CENTERED, reduction: int = 1, splits: dict[str, dict[str, Any]] | None = None
) -> Path:
    """Each split's JSON, by default one for training; a frame's image shows its number."""
    for split, content in (splits or {"train": dnerf_json(lens=lens)}).items():
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
        for index, frame in enumerate(content["frames"]):
            write_image(folder / f"{frame['file_path']}.png", flat(index, lens, reduction))
    return folder


def nerfstudio_json(count: int = 2, lens: Lens = LENSES["pinhole"], **shared: Any) -> dict[str, Any]:
    frames = [
        {"file_path": f"images/f_{index:02}.png", "transform_matrix": opengl_matrix(pose(index))}
        for index in range(count)
    ]
    return {"camera_model": "OPENCV", **intrinsics(lens), **shared, "frames": frames}


def write_nerfstudio(
    folder: Path, lens: Lens = LENSES["pinhole"], reduction: int = 1, content: dict[str, Any] | None = None
) -> Path:
    content = content or nerfstudio_json(lens=lens)
    (folder / "transforms.json").write_text(json.dumps(content))
    for index, frame in enumerate(content["frames"]):
        write_image(folder / frame["file_path"], flat(index, lens, reduction))
    return folder


def write_nerfstudio_frames(folder: Path, lens: Lens, reduction: int) -> Path:
    """With intrinsics in each frame and none for all."""
    frames = [{**frame, **intrinsics(lens)} for frame in nerfstudio_json()["frames"]]
    return write_nerfstudio(folder, lens, reduction, {"frames": frames})


# Neu3D: a row a camera, LLFF's matrix [3, 5] and the depths that bound the scene; its columns are down, right, back


def poses_bounds(count: int, lens: Lens = CENTERED) -> np.ndarray:
    rows = []
    for index in range(count):
        right, down, forward = pose(index).rotation.T
        columns = [down, right, -forward, pose(index).position, (lens.height, lens.width, lens.fx)]
        rows.append([*np.column_stack(columns).ravel(), 0.5, 9.0])
    return np.array(rows)


def neu3d_color(camera: int, index: int) -> np.ndarray:
    return (np.array([40 + 25 * index, 60 + 30 * camera, 200 - 20 * index]) % 256).astype(np.uint8)


def write_neu3d(
    folder: Path,
    lens: Lens = CENTERED,
    reduction: int = 1,
    names: tuple[str, ...] = ("cam00", "cam01"),
    count: int = 2,
    below: str = "",
) -> Path:
    """Write cameras as folders of images."""
    np.save(folder / "poses_bounds.npy", poses_bounds(len(names), lens))
    for camera, name in enumerate(names):
        for index in range(count):
            image = flat(neu3d_color(camera, index), lens, reduction)
            write_image(folder / name / below / f"{index:04d}.png", image)
    return folder


def write_neu3d_videos(
    folder: Path, lens: Lens = SMALL, reduction: int = 1, counts: tuple[int, ...] = (7, 7, 7)
) -> Path:
    """Write cameras as videos of so many frames each."""
    np.save(folder / "poses_bounds.npy", poses_bounds(len(counts), lens))
    for camera, count in enumerate(counts):
        images = [flat(neu3d_color(camera, index), lens, reduction) for index in range(count)]
        write_video(folder / f"cam{camera:02d}.mp4", images)
    return folder


def write_video(path: Path, images: list[np.ndarray], colorspace: str | None = None, **options: str) -> None:
    """Write a video, lossless except for chroma at half the size, with B-frames."""
    with av.open(str(path), "w", options=options) as container:
        stream: Any = container.add_stream("libx264", rate=30, options={"crf": "0"})
        stream.height, stream.width, _ = images[0].shape
        stream.pix_fmt = "yuv420p"
        if colorspace is not None:
            stream.codec_context.colorspace = {"ITU601": 5, "ITU709": 1}[colorspace]
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(
                stream.encode(frame.reformat(format="yuv420p", interpolation=ACCURATE, dst_colorspace=colorspace))
            )
        container.mux(stream.encode())


# HyperNeRF: nerfies' cameras, world to camera; `scene.json` translates and scales the world

HYPERNERF_IDS = ["000000", "000001", "000002", "000003"]
HYPERNERF_SCENE = {"scale": 0.25, "center": [0.5, -1.0, 2.0], "near": 0.1, "far": 3.0}


def hypernerf_json(lens: Lens = LENSES["pinhole"]) -> dict[str, Any]:
    """The contents of each file. The capture alternates between two cameras, as vrig scenes do."""
    ids = HYPERNERF_IDS
    numbers = {
        id_: {"time_id": 5 * k, "warp_id": 99, "appearance_id": 0, "camera_id": k % 2} for k, id_ in enumerate(ids)
    }
    files = {
        "dataset.json": {"count": 4, "ids": ids, "train_ids": ids[::2], "val_ids": ids[1::2]},
        "metadata.json": numbers,
        "scene.json": dict(HYPERNERF_SCENE),
    }
    for index, id_ in enumerate(ids):
        files[f"camera/{id_}.json"] = {
            "orientation": pose(index).rotation.T.tolist(),
            "position": (pose(index).position / HYPERNERF_SCENE["scale"] + HYPERNERF_SCENE["center"]).tolist(),
            "focal_length": lens.fx,
            "principal_point": [lens.cx, lens.cy],
            "skew": 0.0,
            "pixel_aspect_ratio": lens.fy / lens.fx,
            "radial_distortion": [lens.k1, lens.k2, lens.k3],
            "tangential_distortion": [lens.p1, lens.p2],
            "image_size": [lens.width, lens.height],
        }
    return files


def write_hypernerf(
    folder: Path, lens: Lens = LENSES["pinhole"], *copies: int, files: dict[str, Any] | None = None
) -> Path:
    """Write images downscaled by each of `copies`; an image shows its number."""
    for name, content in (files or hypernerf_json(lens)).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(json.dumps(content))
    for reduction in copies or (1,):
        for id_ in HYPERNERF_IDS:
            write_image(folder / "rgb" / f"{reduction}x" / f"{id_}.png", flat(int(id_), lens, reduction))
    return folder


# COLMAP: x_camera = R(q) x + t, with a quaternion whose length need not be 1

COLMAP_LENSES = {
    "SIMPLE_PINHOLE": Lens(fy=300),
    "PINHOLE": Lens(),
    "SIMPLE_RADIAL": Lens(fy=300, k1=-0.15),
    "RADIAL": Lens(fy=300, k1=0.07, k2=0.03),
    "OPENCV": Lens(k1=-0.2, k2=0.05, p1=0.002, p2=-0.003),
}
COLMAP_PARAMETERS = ("fx cx cy", "fx fy cx cy", "fx cx cy k1", "fx cx cy k1 k2", "fx fy cx cy k1 k2 p1 p2")
COLMAP_POINTS = [((0.5, -1.25, 3.0), (255, 0, 51)), ((-2.0, 0.0, 1.5), (0, 102, 255))]
COLMAP_NAMES = ("a_0.png", "a_1.png", "a_2.png")


class ColmapModel(NamedTuple):
    """The contents of the three files: camera 7, an image for each name, and two points."""

    lens: Lens
    names: tuple[str, ...]
    poses: list[tuple[float, ...]]  # q and t of each image

    @property
    def kind(self) -> tuple[int, str, list[float]]:
        """The camera model's number and name, and its parameters."""
        name = next(name for name, lens in COLMAP_LENSES.items() if lens == self.lens)
        number = list(COLMAP_LENSES).index(name)
        return number, name, [getattr(self.lens, key) for key in COLMAP_PARAMETERS[number].split()]


def write_colmap(
    folder: Path,
    lens: Lens = COLMAP_LENSES["PINHOLE"],
    reduction: int = 1,
    names: tuple[str, ...] = COLMAP_NAMES,
    ending: str = "bin",
    place: str = "0",
    poses: list[tuple[float, ...]] | None = None,
) -> Path:
    """Write a sparse model and its images; the second image has no observations."""
    sparse = folder / "sparse" / place
    sparse.mkdir(parents=True, exist_ok=True)
    known = [pose(index) for index in range(len(names))]
    inverses = [(0.98 * each.q * [1, -1, -1, -1], -each.rotation.T @ each.position) for each in known]
    model = ColmapModel(lens, names, poses or [(*q, *t) for q, t in inverses])
    {"bin": write_colmap_binary, "txt": write_colmap_text}[ending](sparse, model)
    for name in names:
        write_image(folder / "images" / name, flat(0, lens, reduction))
    return folder


def write_colmap_binary(sparse: Path, model: ColmapModel) -> None:
    number, _, parameters = model.kind
    camera = struct.pack("<QiiQQ", 1, 7, number, model.lens.width, model.lens.height)
    (sparse / "cameras.bin").write_bytes(camera + struct.pack(f"<{len(parameters)}d", *parameters))
    images = struct.pack("<Q", len(model.names))
    for index, (name, numbers) in enumerate(zip(model.names, model.poses, strict=True)):
        seen = 0 if index == 1 else 2
        images += struct.pack("<i7di", index + 1, *numbers, 7) + name.encode() + b"\0"
        images += struct.pack("<Q", seen) + struct.pack("<ddq", 10.5, 20.5, -1) * seen
    (sparse / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(COLMAP_POINTS))
    for index, (position, color) in enumerate(COLMAP_POINTS):
        points += struct.pack("<Q3d3BdQ", index, *position, *color, 0.7, index) + struct.pack("<ii", 1, 0) * index
    (sparse / "points3D.bin").write_bytes(points)


def write_colmap_text(sparse: Path, model: ColmapModel) -> None:
    _, kind, parameters = model.kind
    line = " ".join(map(str, [7, kind, model.lens.width, model.lens.height, *parameters]))
    (sparse / "cameras.txt").write_text(f"# Camera list\n\n{line}\n")
    lines = ["# Image list with two lines of data per image:", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for index, (name, numbers) in enumerate(zip(model.names, model.poses, strict=True)):
        lines += [" ".join(map(str, [index + 1, *numbers, 7, name])), "" if index == 1 else "10.5 20.5 -1"]
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [[index, *position, *color, 0.7, 1, 0] for index, (position, color) in enumerate(COLMAP_POINTS)]
    (sparse / "points3D.txt").write_text("# points\n" + "\n".join(" ".join(map(str, row)) for row in rows))


class Layout(NamedTuple):
    """A writer of datasets, with a lens and with images that are smaller than stated by a factor."""

    write: Callable[[Path, Lens, int], Path]
    lens: Lens


LAYOUTS = {
    "dnerf": Layout(write_dnerf, CENTERED),
    "neu3d": Layout(write_neu3d, CENTERED),
    "neu3d-videos": Layout(write_neu3d_videos, SMALL),
    **{f"nerfstudio-{name}": Layout(write_nerfstudio, lens) for name, lens in LENSES.items()},
    **{f"nerfstudio-frames-{name}": Layout(write_nerfstudio_frames, lens) for name, lens in LENSES.items()},
    **{f"hypernerf-{name}": Layout(write_hypernerf, lens) for name, lens in LENSES.items()},
    **{f"colmap-bin-{name}": Layout(write_colmap, lens) for name, lens in COLMAP_LENSES.items()},
    **{f"colmap-txt-{name}": Layout(partial(write_colmap, ending="txt"), lens) for name, lens in COLMAP_LENSES.items()},
}
