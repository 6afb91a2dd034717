"""Intrinsics that don't fit their images, mostly those of images in another resolution."""

import math
from typing import Any

from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.images import ImageSize
from msdgs_train.datasets.common.readers import JsonObject
from msdgs_train.datasets.common.scene_data import SceneData

SAME = 0.1
"""Relative difference below which both coordinates of a principal point state the same resolution."""

OTHER = 1.4
"""Factor from which this is another resolution than the image's, and not a principal point off its center."""

MAX_ANGLE_ERROR = 0.02
"""Relative difference of focal lengths, from which an angle contradicts them."""


def other_resolution(cx: float, cy: float, image: ImageSize) -> ImageSize | None:
    """The size of the images that have this principal point in their center, if it is another one of the same shape."""
    across, down = 2 * cx / image.width, 2 * cy / image.height
    if min(across, down) <= 0 or abs(across - down) > SAME * down or 1 / OTHER < across < OTHER:
        return None
    return ImageSize(round(across * image.width), round(down * image.height))


def check_resolution(entry: JsonObject, cx: float, cy: float, image: ImageSize) -> None:
    """Raise `DatasetInvalid` if an entry that states no size has the intrinsics of another one."""
    stated = other_resolution(cx, cy, image)
    if stated is not None:
        problem = f"and cy are {cx:g} and {cy:g}, the center of images of {stated}, but this one is {image}: "
        raise entry.invalid("cx", problem + "give w and h, the size that fl_x, fl_y, cx and cy are for")


def contradiction(values: JsonObject, camera: Camera) -> str | None:
    """A warning if `values` has a focal length and an angle that state different ones; the focal length is used."""
    for axis, focal, length in (("x", camera.fx, camera.width), ("y", camera.fy, camera.height)):
        fl, angle = f"fl_{axis}", f"camera_angle_{axis}"
        if values.get(fl) is None or values.get(angle) is None:
            continue
        if not _is_field_of_view(values.get(angle), focal, length):
            got = 2 * math.atan(0.5 * length / focal)
            problem = (
                f"{values.file}: `{values.prefix}{fl}` makes a field of view of {got:.4f} radians, `{angle}` states "
            )
            problem += f"{str(values.get(angle))[:20]}; {fl} is used. Remove the wrong one, or give w and h, the size "
            return problem + "that it is for"
    return None


def _is_field_of_view(angle: Any, focal: float, length: int) -> bool:
    if type(angle) not in (int, float) or not 0 < angle < math.pi:
        return False
    return abs(0.5 * length / math.tan(0.5 * angle) - focal) <= MAX_ANGLE_ERROR * focal


def principal_point_warnings(scene: SceneData) -> tuple[str, ...]:
    """A warning if principal points lie outside of their images, as those of another resolution do."""
    frames = [frame for split in scene.splits.values() for frame in split]
    outside = [frame for frame in frames if not _is_inside(frame.camera)]
    if not outside:
        return ()
    camera, size = outside[0].camera, ImageSize(outside[0].camera.width, outside[0].camera.height)
    other = other_resolution(camera.cx, camera.cy, size)
    likely = f"it is the center of images {other.width / size.width:.3g} times as wide" if other else "check cx and cy"
    problem = f"the principal point of {len(outside)} of {len(frames)} images lies outside of them, first of "
    problem += (
        f"{outside[0].name}: ({camera.cx:.6g}, {camera.cy:.6g}) in {size}. Unless the images are cut from larger "
    )
    return (problem + f"ones, the intrinsics are wrong and the model will be empty: {likely}",)


def _is_inside(camera: Camera) -> bool:
    return 0 <= camera.cx <= camera.width and 0 <= camera.cy <= camera.height
