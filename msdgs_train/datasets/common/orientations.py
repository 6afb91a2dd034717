"""Images that their EXIF orientation turns or mirrors where they are shown. Pixels are read as they are stored."""

from msdgs_train.datasets.common.images import TURNED, read_header
from msdgs_train.datasets.common.scene_data import Frame, SceneData

AS_STORED = (0, 1)


def orientation_warnings(scene: SceneData) -> tuple[str, ...]:
    """A warning if images are turned without another size, or nothing says which size they have, so that poses may be
    of the turned images."""
    frames = [frame for split in scene.splits.values() for frame in split if frame.image_path in frame.files]
    turned = [frame for frame in frames if _may_be_turned(frame)]
    if not turned:
        return ()
    number = read_header(turned[0].image_path).orientation
    problem = (
        f"{len(turned)} of {len(frames)} images, such as {turned[0].name}, are read as they are stored, as COLMAP "
    )
    problem += (
        f"does, though their EXIF orientation (first {number}) turns or mirrors them where they are shown: if their "
    )
    return (problem + "poses are of upright images, store them upright, without it",)


def _may_be_turned(frame: Frame) -> bool:
    size, orientation = read_header(frame.image_path)
    tells = orientation in TURNED and size.width != size.height and frame.states_size
    return orientation not in AS_STORED and not tells
