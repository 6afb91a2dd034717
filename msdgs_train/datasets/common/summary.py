"""One line on what was read of a dataset."""

from msdgs_train.datasets.common.backdrop import Color
from msdgs_train.datasets.common.scene_data import SceneData


def summary(scene: SceneData, background: Color) -> str:
    """Layout, images, cameras, times, points and normalization of a scene, such as a user would check them, and the
    color behind it."""
    frames = [frame for frames in scene.splits.values() for frame in frames]
    counts = (f"{len(each):,} {split}" for split, each in scene.splits.items() if each)
    sizes = sorted({(frame.camera.width, frame.camera.height) for frame in frames})
    shown = [f"{width}×{height}" for width, height in sizes[:2]]
    poses, times = len({frame.camera.camera_to_world.tobytes() for frame in frames}), {frame.t for frame in frames}
    first, last = scene.time_range
    place = scene.scene_to_world
    parts = [
        f"{scene.layout} layout",
        f"{' + '.join(counts)} " + ("image" if len(frames) == 1 else "images"),
        " and ".join(shown) + (f" and {len(sizes) - 2} other sizes" if len(sizes) > 2 else ""),
        _count(poses, "camera pose"),
        f"{_count(len(times), 'time')} from {first:g} to {last:g}" if len(times) > 1 else "one time",
        _count(len(scene.points), "point") if scene.points is not None else "no points",
    ]
    if masked := sum(frame.mask_path is not None for frame in frames):
        parts.append(f"masks of {'all' if masked == len(frames) else f'{masked:,}'} images")
    parts.append("background #" + "".join(f"{round(255 * value):02x}" for value in background))
    if not place.is_identity:
        x, y, z = place.offset
        parts.append(f"trained at {1 / place.scale:.3g} times its size around ({x:.10g}, {y:.10g}, {z:.10g})")
    return ", ".join(parts)


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" + "s" * (number != 1)
