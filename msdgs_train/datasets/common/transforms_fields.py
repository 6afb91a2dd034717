"""The fields of `transforms*.json`, as NeRF's Blender scripts, instant-ngp, nerfstudio and BlenderNeRF write them."""

import re
from fnmatch import fnmatchcase
from typing import Any

from msdgs_serve.scene.fields import FieldTable
from msdgs_train.datasets.common.readers import JsonObject

APPLIED = (
    *("frames", "file_path", "transform_matrix", "time", "mask_path", "ply_file_path"),
    *("train_filenames", "val_filenames", "test_filenames"),
    *("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "cx", "cy", "w", "h"),
    *("k1", "k2", "k3", "p1", "p2"),
)

LENS_NAMES = ("camera_model", "camera_type", "lens", "lens_*", "projection*", "distortion_model")
"""Fields that name the lens. A number, such as Blender's focal length in millimeters, says nothing about its kind."""

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Lenses that are read, in any case; the others' distortion can't be undone to one pinhole image."""
SYNONYMS = (
    *("PERSP", "RECTILINEAR", "LINEAR", "PLANAR", "FRAME", "NONE", "UNDISTORTED", "NO_DISTORTION"),
    *("BROWN", "BROWN_CONRADY", "PLUMB_BOB", "RADTAN", "RAD_TAN", "RADIAL_TANGENTIAL", "PINHOLE_RADTAN"),
)
"""Other programs' names of a pinhole and of the distortion `k1`, `k2`, `p1`, `p2`, `k3`."""

OF_EXIF = ("lens_make", "lens_model", "lens_name", "lens_id", "lens_info", "lens_specification", "lens_serial*")
"""Fields that name a product, as `lens` and `camera_model` may do."""
OTHER_LENS = re.compile(
    r"fish|equi|latlong|ortho|sphere|spheric|panoram|omni|kannala|stereograph|cylind|cubemap|prism|theta|rational|vr180|360"
    r"|full_opencv|division|\bfov\b|\be?ucm\b|\bmei\b",
    re.IGNORECASE,
)
"""What names of other lenses contain, also those of products."""

UNDISTORT = "undistort the images first, to a pinhole camera"
NOT_MOVING = (
    "each image is taken at one moment, by a camera that stands still; remove the field to train as if it were so"
)
REFUSED = {
    "is_fisheye": UNDISTORT,
    **dict.fromkeys(("k4", "k5", "k6", "s1", "s2", "s3", "s4", "skew", "b1", "b2", "distortion_params"), UNDISTORT),
    **dict.fromkeys(("ftheta_*", "latlong", "equirectangular", "fisheye_crop_radius"), UNDISTORT),
    **dict.fromkeys(("ortho*", "is_ortho*"), "only perspective cameras can be read"),
    **dict.fromkeys(
        ("from_mitsuba", "normal_mts_args"), "turn each pose by 180° around the camera's y axis, to OpenGL axes"
    ),
    **dict.fromkeys(("rolling_shutter*", "transform_matrix_start", "transform_matrix_end", "motionblur*"), NOT_MOVING),
    **dict.fromkeys(
        ("white_transparent", "black_transparent"), "give the images an alpha channel, and remove the field"
    ),
    "mask_color": "give each frame a mask_path, an image that is black where pixels don't count",
    "envmap": "only one color can be behind the scene; remove the field to train without it",
    "sharpen": "sharpen the images themselves, or remove the field",
    "sharpness_discard_threshold": "remove the blurred images from the frames instead",
    "driver_parameters": "light must not change; remove the field to train as if it didn't",
}
"""Fields that would change the result, with what to do about them. Those that are off, 0 or empty are read."""

HARMLESS = (
    *("aabb", "aabb_scale", "render_aabb*", "scale", "offset", "up", "n_frames", "n_extra_learnable_dims"),
    *(
        "sharpness",
        "rotation",
        "colmap_im_id",
        "camera_label",
        "camera_id",
        "camera_index",
        "mono",
        "fps",
        "near",
        "far",
    ),
    *("applied_transform", "applied_scale", "orientation_override", "auto_scale_poses_override", "center_*"),
    *("depth_*", "integer_depth_scale", "normal_*", "enable_depth_loading", "enable_ray_loading"),
    *("importance_sampling", "fix_premult", "exposure_time", "motion_blur_score", "camera_*_velocity"),
)

TRANSFORMS_FIELDS = FieldTable(
    "transforms.json",
    {
        **dict.fromkeys(APPLIED, "applied"),
        **dict.fromkeys((*REFUSED, *LENS_NAMES), "refused"),
        **dict.fromkeys(HARMLESS, "harmless"),
    },
)


def check_fields(entry: JsonObject) -> None:
    """Raise `DatasetInvalid` naming the first field that would change the result and can't be applied."""
    for key, value in entry.values.items():
        if _names_lens(key):
            if key == "camera_model" and value is not None and not isinstance(value, str):
                raise entry.invalid(key, f"must be one of {', '.join(PINHOLES)}, got {value!r}")
            if isinstance(value, str) and value and not _is_pinhole(key, value):
                problem = f"must be one of {', '.join(PINHOLES)}, got {value!r}: {UNDISTORT}"
                raise entry.invalid(key, f"{problem}; remove the field if it doesn't name the lens's projection")
        elif _is_on(value):
            remedy = next((text for pattern, text in REFUSED.items() if fnmatchcase(key, pattern)), None)
            if remedy is not None:
                raise entry.invalid(key, f"must be off or 0, got {str(value)[:60]}: {remedy}")


def _names_lens(key: str) -> bool:
    return any(fnmatchcase(key, pattern) for pattern in LENS_NAMES)


def _is_pinhole(key: str, value: str) -> bool:
    """Whether a text names a pinhole, or a product, whose name says nothing else."""
    if re.sub(r"[^A-Z0-9]+", "_", value.upper()) in (*PINHOLES, *SYNONYMS):
        return True
    is_product = any(fnmatchcase(key, pattern) for pattern in OF_EXIF)
    is_product |= key in ("lens", "camera_model") and re.fullmatch("[A-Za-z_]+", value) is None
    return is_product and OTHER_LENS.search(value) is None


def _is_on(value: Any) -> bool:
    """Whether a field has an effect; lists of zeros, as of distortion, have none."""
    return any(map(_is_on, value)) if isinstance(value, list) else value not in (None, False, 0, "", "0", "false", {})
