"""Intrinsics that don't fit their images, mostly those of images in another resolution."""

import math
from pathlib import Path
from typing import Any

from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.images import ImageSize
from msdgs_train.datasets.common.readers import DatasetInvalid, JsonObject
from msdgs_train.datasets.common.scene_data import SceneData

SAME = 0.1
"""Relative difference below which both coordinates of a principal point state the same resolution."""

OTHER = 1.4
"""Factor from which this is another resolution than the image's, and not a principal point off its center."""

FAR, CORNER = 1 / 4, 1 / 16
"""Of an image's sides: distance from the middle that is unlikely in both, and the size of a corner."""

MIN_FOCAL = 0.05
"""Of an image's width, a field of view of 169°: pinhole images show less."""

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


def check_intrinsics(scene: SceneData, folder: Path) -> tuple[str, ...]:
    """Warnings about principal points that are far from the middle of their images, as those of another resolution are.

    Raises `DatasetInvalid` if no image can have its principal point or its focal length.
    """
    frames = [frame for split in scene.splits.values() for frame in split]
    first = frames[0].camera
    if all(frame.camera.fx < MIN_FOCAL * frame.camera.width for frame in frames):
        problem = (
            f"of {first.fx:.6g} pixels in {_size(first)} are too short for a lens, first of {frames[0].name}: give "
        )
        raise DatasetInvalid(folder, "focal lengths", problem + "fl_x and fl_y, or fx and fy, in pixels of the images")
    if all(_is_in_corner(frame.camera) for frame in frames):
        problem = (
            f"lie in or beyond a corner of the images, first of {frames[0].name}: {_point(first)}; {_likely(first)}"
        )
        raise DatasetInvalid(folder, "principal points", problem)
    far = [frame for frame in frames if _is_far(frame.camera)]
    if not far:
        return ()
    problem = f"the principal point of {len(far)} of {len(frames)} images is far from their middle, first of "
    problem += (
        f"{far[0].name}: {_point(far[0].camera)}. Unless the images are cut from larger ones, the intrinsics are "
    )
    return (problem + f"wrong and the model will be empty: {_likely(far[0].camera)}",)


def _size(camera: Camera) -> ImageSize:
    return ImageSize(camera.width, camera.height)


def _point(camera: Camera) -> str:
    return f"({camera.cx:.6g}, {camera.cy:.6g}) in {_size(camera)}"


def _likely(camera: Camera) -> str:
    if other_resolution(camera.cx, camera.cy, _size(camera)) is None:
        return "check cx and cy, in pixels from the upper left corner"
    times = f"{2 * camera.cx / camera.width:.3g}"
    return f"it is the center of images {times} times as wide: give intrinsics and size of the same images"


def _is_in_corner(camera: Camera) -> bool:
    """Whether it is close to the upper left corner, as fractions of the size and distances from the middle are, or in
    or beyond the lower right one, as that of a larger image is."""
    across, down = camera.cx / camera.width, camera.cy / camera.height
    return max(across, down) <= CORNER or (min(across, down) >= 1 and abs(across - down) <= SAME * down)


def _is_far(camera: Camera) -> bool:
    across, down = abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)
    is_other = other_resolution(camera.cx, camera.cy, _size(camera)) is not None
    return is_other or max(across, down) >= 0.5 or min(across, down) >= FAR
