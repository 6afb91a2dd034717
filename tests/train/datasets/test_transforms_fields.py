"""Each field of transforms.json and of transforms_train.json is applied, refused by name, or harmless."""

import json
from collections.abc import Callable
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_train.datasets import DatasetInvalid, SceneData, load_scene
from msdgs_train.datasets.common.images import write_png
from msdgs_train.datasets.common.transforms_fields import TRANSFORMS_FIELDS
from tests.train.datasets import layouts
from tests.train.datasets.layouts import LENSES, SMALL, flat, opengl_matrix, pose

FILES = {"dnerf": "transforms_train.json", "nerfstudio": "transforms.json"}
POINTS = (
    "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 1 2\n"
)
OF_LAYOUT = {
    "dnerf": ("train_filenames", "val_filenames", "test_filenames"),
    "nerfstudio": (),
}
"""Fields that a layout refuses."""

each_layout = pytest.mark.parametrize("layout", FILES)


def write(folder: Path, layout: str, frame: dict[str, Any] | None = None, **shared: Any) -> Path:
    """Two frames with the fields of most files; `frame` changes the second, `shared` those of both (None: none)."""
    images = ("a.png", "b.png", "c.png")
    frames = [
        {"file_path": images[index], "transform_matrix": opengl_matrix(pose(index)), "time": float(index)}
        for index in range(2)
    ]
    frames[1].update(frame or {})
    content = {"fl_x": SMALL.fx, "w": SMALL.width, "h": SMALL.height, **shared}
    content = {key: value for key, value in content.items() if value is not None}
    for index, name in enumerate(images):
        write_png(folder / name, flat(50 * index + 50, SMALL))
    mask = np.full((SMALL.height, SMALL.width, 3), 255, np.uint8)
    mask[:5] = 0
    write_png(folder / "mask.png", mask)
    (folder / "points.ply").write_text(POINTS)
    (folder / FILES[layout]).write_text(json.dumps({"frames": frames, **content}))
    return folder


def outcome(scene: SceneData) -> str:
    """All that training uses, as text."""
    frames = [(split, frame) for split, frames in scene.splits.items() for frame in frames]
    cameras = [frame.camera for _, frame in frames]
    values = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height, c.camera_to_world.tolist()) for c in cameras]
    pixels = [(frame.load_rgba().tobytes(), frame.load_mask()) for _, frame in frames]
    rest = [(split, frame.name, frame.t, frame.distortion) for split, frame in frames]
    return repr((values, pixels, rest, scene.scene_half_size, scene.points))


APPLIED: dict[str, dict[str, Any]] = {
    "file_path": {"frame": {"file_path": "c.png"}},
    "transform_matrix": {"frame": {"transform_matrix": opengl_matrix(pose(7))}},
    "time": {"frame": {"time": 0.5}},
    "mask_path": {"mask_path": "mask.png"},
    "ply_file_path": {"ply_file_path": "points.ply"},
    "train_filenames": {"train_filenames": ["a.png"]},
    "val_filenames": {"train_filenames": ["a.png"], "val_filenames": ["b.png"]},
    "test_filenames": {"train_filenames": ["a.png"], "test_filenames": ["b.png"]},
    "frames": {"frames": [{"file_path": "c.png", "transform_matrix": opengl_matrix(pose(0))}]},
    "fl_x": {"fl_x": 44.0},
    "fl_y": {"fl_y": 44.0},
    "camera_angle_x": {"fl_x": None, "camera_angle_x": 0.5},
    "camera_angle_y": {"camera_angle_y": 0.5},
    "x_fov": {"fl_x": None, "x_fov": 50.0},
    "y_fov": {"y_fov": 50.0},
    "cx": {"cx": 13.0},
    "cy": {"cy": 13.0},
    "w": {"w": 2 * SMALL.width, "h": 2 * SMALL.height},
    "h": {"w": 2 * SMALL.width, "h": 2 * SMALL.height},
    **{name: {name: 0.01} for name in ("k1", "k2", "k3", "p1", "p2")},
}
REFUSED: dict[str, tuple[Any, ...]] = {
    "camera_model": ("OPENCV_FISHEYE", "EQUIRECTANGULAR", "fisheye", "FISHEYE624", "ORTHOPHOTO", "VR180_L", "EUCM"),
    "camera_type": ("equirectangular",),
    "lens": ("fisheye", "Canon EF 8-15mm f/4L Fisheye USM"),
    "lens_mode": ("latlong",),
    "projection_type": ("ORTHO",),
    "distortion_model": ("kannala_brandt",),
    "is_fisheye": (True, 1),
    **dict.fromkeys(("k4", "k5", "k6", "s1", "s2", "s3", "s4", "skew", "b1", "b2"), (0.1,)),
    "distortion_params": ([0, 0, 0.1, 0],),
    "ftheta_p0": (0.2,),
    "latlong": (True,),
    "equirectangular": (True, {"fov": 360}),
    "fisheye_crop_radius": (700.0,),
    "ortho_scale": (6.0,),
    "is_ortho": (True,),
    "from_mitsuba": (True,),
    "normal_mts_args": (["scene.xml"],),
    "rolling_shutter": ([0.0, 0.0, 0.3, 0.0],),
    "rolling_shutter_time": (0.01,),
    "transform_matrix_start": (opengl_matrix(pose(3)),),
    "transform_matrix_end": (opengl_matrix(pose(3)),),
    "motionblur_amount": (0.5,),
    "white_transparent": (True,),
    "black_transparent": (True,),
    "mask_color": ("#ff00ff",),
    "envmap": ("sky.png",),
    "sharpen": (0.5,),
    "sharpness_discard_threshold": (0.7,),
    "driver_parameters": ({"LightX": 1.0},),
}
OFF = (None, False, 0, 0.0, [], [0.0, 0.0], "", {})
HARMLESS: dict[str, Any] = {
    "aabb": [[0, 0, 0], [1, 1, 1]],
    "render_aabb_to_local": [1, 0, 0],
    "offset": [0.5, 0.5, 0.5],
    "up": [0, 0, 1],
    "applied_transform": opengl_matrix(pose(5))[:3],
    "orientation_override": "none",
    "center_method": "poses",
    "depth_file_path": "none.png",
    "normal_path": "none.png",
    "camera_linear_velocity": [1, 2, 3],
    "camera_label": "front",
    "mono": True,
    **dict.fromkeys(("aabb_scale", "scale", "n_frames", "n_extra_learnable_dims", "sharpness", "rotation"), 16),
    **dict.fromkeys(("colmap_im_id", "camera_id", "camera_index", "fps", "near", "far", "applied_scale"), 3),
    **dict.fromkeys(("auto_scale_poses_override", "enable_depth_loading", "enable_ray_loading"), True),
    **dict.fromkeys(("importance_sampling", "fix_premult"), True),
    **dict.fromkeys(("integer_depth_scale", "exposure_time", "motion_blur_score"), 0.25),
}


@pytest.mark.parametrize(("use", "examples"), [("applied", APPLIED), ("refused", REFUSED), ("harmless", HARMLESS)])
def test_each_field_has_an_example(use: str, examples: dict[str, Any]):
    listed = [pattern for pattern, of in TRANSFORMS_FIELDS.uses.items() if of == use]
    assert {name for name in examples if TRANSFORMS_FIELDS.use(name) != use} == set()
    assert [pattern for pattern in listed if not any(fnmatchcase(name, pattern) for name in examples)] == []


@each_layout
@pytest.mark.parametrize("name", APPLIED)
def test_an_applied_field_has_an_effect(tmp_path: Path, layout: str, name: str):
    (tmp_path / "plain").mkdir()
    plain = outcome(load_scene(write(tmp_path / "plain", layout)))
    folder = write(tmp_path, layout, **APPLIED[name])
    if name in OF_LAYOUT[layout]:
        with pytest.raises(DatasetInvalid, match=r"`\w+_filenames` .* name this one transforms\.json"):
            load_scene(folder)
    else:
        scene = load_scene(folder)
        assert outcome(scene) != plain
        assert scene.warnings == ()


@each_layout
@pytest.mark.parametrize("name", REFUSED)
def test_a_refused_field_is_named(tmp_path: Path, layout: str, name: str):
    for value in REFUSED[name]:
        for of_frame, of_all in (({}, {name: value}), ({name: value}, {})):
            with pytest.raises(DatasetInvalid, match=rf"`frames\[[01]\]\.{name}` must be ") as caught:
                load_scene(write(tmp_path, layout, of_frame, **of_all))
            assert ": " in str(caught.value).partition("got")[2]  # what to do


@each_layout
def test_refused_fields_that_are_off_have_no_effect(tmp_path: Path, layout: str):
    plain = outcome(load_scene(write(tmp_path, layout)))
    lenses = ("camera_model", "camera_type", "lens", "lens_mode", "projection_type", "distortion_model")
    for off in OFF:
        flags = {name: off for name in REFUSED if name not in lenses}
        assert outcome(load_scene(write(tmp_path, layout, flags))) == plain
    for lens in ("PINHOLE", "opencv", "perspective", "SIMPLE_RADIAL", ""):
        assert outcome(load_scene(write(tmp_path, layout, **dict.fromkeys(lenses, lens)))) == plain
    assert outcome(load_scene(write(tmp_path, layout, lens=35.0))) == plain  # Blender's, in millimeters
    for lens in ("PERSP", "none", "plumb_bob", "radtan", "Brown-Conrady", "linear", "Plumb Bob"):
        assert outcome(load_scene(write(tmp_path, layout, **dict.fromkeys(lenses, lens)))) == plain


@each_layout
def test_names_of_products_name_no_lens(tmp_path: Path, layout: str):
    plain = outcome(load_scene(write(tmp_path, layout)))
    products: dict[str, Any] = {"camera_model": "Canon EOS R5", "lens": "SEL35F18", "lens_make": "Apple"}
    products["lens_model"] = "iPhone 15 Pro back camera 6.765mm f/1.78"
    assert outcome(load_scene(write(tmp_path, layout, **products))) == plain


@each_layout
def test_harmless_fields_have_no_effect(tmp_path: Path, layout: str):
    plain = outcome(load_scene(write(tmp_path, layout)))
    scene = load_scene(write(tmp_path, layout, HARMLESS, **HARMLESS))
    assert outcome(scene) == plain
    assert scene.warnings == ()


@each_layout
def test_unknown_fields_are_named_in_one_warning(tmp_path: Path, layout: str):
    (warning,) = load_scene(write(tmp_path, layout, {"shutter": 3, "time": 0.5}, lightness=1, Fl_x=2)).warnings
    assert warning.startswith(f"{tmp_path / FILES[layout]}: `lightness`, `Fl_x`, `shutter` are not known fields")


def test_each_file_of_a_layout_has_its_own_warning(tmp_path: Path):
    write(tmp_path, "dnerf", haze=1)
    content = (tmp_path / "transforms_train.json").read_text()
    for split in ("val", "test"):
        (tmp_path / f"transforms_{split}.json").write_text(content)
    named = [text for text in load_scene(tmp_path).warnings if "haze" in text]
    assert [text.split(":")[0][-8:] for text in named] == ["ain.json", "val.json", "est.json"]


@pytest.mark.parametrize("name", ["barrel", "pincushion", "tangential"])
def test_distortion_is_the_same_in_both_layouts(tmp_path: Path, name: str):
    frames = {}
    for layout in FILES:
        (tmp_path / layout).mkdir()
        content = layouts.nerfstudio_json(1, LENSES[name])
        folder = layouts.write_nerfstudio(tmp_path / layout, LENSES[name], content=content)
        (folder / "transforms.json").rename(folder / FILES[layout])
        noise = np.random.default_rng(0).integers(0, 256, size=(240, 320, 3), dtype=np.uint8)
        write_png(folder / "images" / "f_00.png", noise)
        frames[layout] = load_scene(folder).splits["train"][0]
    assert frames["dnerf"].distortion == frames["nerfstudio"].distortion
    assert frames["dnerf"].distortion is not None
    assert (frames["dnerf"].load_rgba() == frames["nerfstudio"].load_rgba()).all()


WRONG_RESOLUTION = [(64.0, 48.0), (32.0, 24.0), (8.0, 6.0), (4.0, 3.1), (320.0, 250.0)]


@each_layout
@pytest.mark.parametrize(("cx", "cy"), WRONG_RESOLUTION)
def test_intrinsics_of_another_resolution_are_refused_without_a_size(tmp_path: Path, layout: str, cx: float, cy: float):
    folder = write(tmp_path, layout, fl_x=2 * cx, cx=cx, cy=cy, w=None, h=None)
    stated = rf"the center of images of {2 * cx:g}×{round(2 * cy)}, but this one is 32×24: give w and h"
    with pytest.raises(DatasetInvalid, match=stated):
        load_scene(folder)
    known = load_scene(write(tmp_path, layout, fl_x=2 * cx, cx=cx, cy=cy, w=2 * cx, h=1.5 * cx))
    assert abs(known.splits["train"][0].camera.fx - 32) < 1e-6
    assert known.warnings == ()


@each_layout
def test_a_principal_point_off_the_center_is_read(tmp_path: Path, layout: str):
    for cx, cy in ((20.0, 10.0), (16.0, 4.0), (12.0, 9.0), (31.0, 12.0)):
        scene = load_scene(write(tmp_path, layout, cx=cx, cy=cy, w=None, h=None))
        assert (scene.splits["train"][0].camera.cx, scene.warnings) == (cx, ())


FAR = [
    *((-3.0, 12.0, "check cx"), (16.0, 24.5, "check cx"), (16.0, 24.0, "check cx"), (3.0, 23.0, "check cx")),
    *((30.4, 22.8, "1.9 times as wide"), (8.0, 6.0, "0.5 times as wide"), (4.0, 3.0, "0.25 times as wide")),
]


@each_layout
@pytest.mark.parametrize(("cx", "cy", "hint"), FAR)
def test_a_principal_point_far_from_the_middle_is_told(tmp_path: Path, layout: str, cx: float, cy: float, hint: str):
    (warning,) = load_scene(write(tmp_path, layout, cx=cx, cy=cy)).warnings
    assert "the principal point of 2 of 2 images is far from their middle, first of " in warning
    assert f": ({cx:g}, {cy:g}) in 32×24" in warning
    assert hint in warning.rpartition("empty: ")[2]


IMPOSSIBLE = [
    *((32.0, 24.0, "2 times as wide"), (64.0, 48.0, "4 times as wide"), (2.0, 1.5, "0.125 times as wide")),
    *((0.5, 0.5, "from the upper left corner"), (-1.2, 0.7, "from the upper left corner")),
]


@each_layout
@pytest.mark.parametrize(("cx", "cy", "hint"), IMPOSSIBLE)
def test_principal_points_in_a_corner_of_all_images_are_refused(
    tmp_path: Path, layout: str, cx: float, cy: float, hint: str
):
    with pytest.raises(DatasetInvalid, match=rf"`principal points` lie .* \({cx:g}, {cy:g}\) in 32×24; .*{hint}"):
        load_scene(write(tmp_path, layout, cx=cx, cy=cy))
    tiles = load_scene(write(tmp_path, layout, {"cx": 0.0, "cy": 24.0}, cx=cx, cy=cy))
    assert "2 of 2 images is far" in tiles.warnings[0]


@each_layout
@pytest.mark.parametrize("focal", [1.1, 0.035])
def test_focal_lengths_in_other_units_are_refused(tmp_path: Path, layout: str, focal: float):
    with pytest.raises(DatasetInvalid, match=rf"`focal lengths` of {focal:g} pixels in 32×24 are too short"):
        load_scene(write(tmp_path, layout, fl_x=focal))


CONTRADICTIONS: list[Callable[..., Path]] = [
    partial(write, fl_x=30.0, camera_angle_x=0.5),
    partial(write, fl_y=30.0, camera_angle_y=0.5),
    partial(write, frame={"fl_x": 60.0, "camera_angle_x": 1.0}),
    partial(write, fl_x=120.0, camera_angle_x=0.98, w=None, h=None),
    partial(write, camera_angle_x=56.1),
    partial(write, camera_angle_x=0),
    partial(write, camera_angle_x="wide"),
]


@each_layout
@pytest.mark.parametrize("of", CONTRADICTIONS)
def test_a_focal_length_that_an_angle_contradicts_is_told(tmp_path: Path, layout: str, of: Callable[..., Path]):
    (warning,) = load_scene(of(tmp_path, layout)).warnings
    assert "makes a field of view of" in warning
    assert "is used. Remove the wrong one, or give w and h" in warning


@each_layout
def test_an_angle_that_agrees_or_is_of_all_frames_is_no_contradiction(tmp_path: Path, layout: str):
    angle = 2 * np.arctan(0.5 * SMALL.width / 60)
    assert load_scene(write(tmp_path, layout, {"fl_x": 50.0}, fl_x=60.0, camera_angle_x=angle)).warnings == ()
    frames = {"fl_x": 50.0}
    assert load_scene(write(tmp_path, layout, frames, fl_x=None, camera_angle_x=angle)).warnings == ()
