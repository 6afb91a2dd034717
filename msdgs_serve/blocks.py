"""Frames in blocks by scene and time, which are drawn by this process or by workers on other machines."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging import ImageFormat, encode
from msdgs_serve.imaging.formats import default_channels
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Camera

MAX_FRAMES = 16
"""Frames per block: as many are lost if a worker dies or Ctrl-C is pressed."""


class View(NamedTuple):
    """Scene, camera and time of one frame."""

    scene: Path
    camera: Camera
    t: float


class Frame(NamedTuple):
    """One frame of a block; `number` is its index among all frames."""

    number: int
    camera: Camera
    t: float


@dataclass(frozen=True)
class Block:
    """Frames of one scene, sorted by time, so that each time is posed once."""

    scene: Path
    frames: tuple[Frame, ...]


@dataclass(frozen=True)
class OutputOptions:
    """How frames are drawn and encoded; their motion ends with the scene's time."""

    image_format: ImageFormat
    quality: int | None
    options: RenderOptions


def plan_blocks(views: Sequence[View], numbers: Sequence[int], workers: int = 1) -> list[Block]:
    """Return the frames `numbers` of `views` in blocks, sorted by scene and time.

    Blocks have at most `MAX_FRAMES` frames, and fewer if there were less than four blocks per worker. Frames of one
    time stay in one block if they fit into one.
    """
    size = max(1, min(MAX_FRAMES, len(numbers) // (4 * workers)))
    scenes = list(dict.fromkeys(view.scene for view in views))
    blocks = []
    for scene in scenes:
        frames = [Frame(number, views[number].camera, views[number].t) for number in numbers]
        frames = [frame for frame in frames if views[frame.number].scene == scene]
        blocks += [Block(scene, tuple(part)) for part in _cut(sorted(frames, key=_by_time), size)]
    return blocks


def draw_block(
    block: Block, session: DeformationSession, renderer: Renderer, look: OutputOptions
) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the encoded file of each frame."""
    channels, options, dt = default_channels(look.image_format), look.options, look.options.motion_dt
    channels += () if dt is None else ("motion",)
    _, last = session.scene.metadata.time_range
    for number, camera, t in block.frames:
        if dt is not None:
            options = replace(options, motion_dt=min(dt, last - t))
        image = renderer.render(session, camera, t, options)
        yield number, encode(image, look.image_format, look.quality, channels)


def _by_time(frame: Frame) -> tuple[float, int]:
    return frame.t, frame.number


def _cut(frames: Sequence[Frame], size: int) -> Iterator[list[Frame]]:
    block: list[Frame] = []
    for index, frame in enumerate(frames):
        begins_time = index == 0 or frames[index - 1].t != frame.t
        together = sum(other.t == frame.t for other in frames[index : index + size]) if begins_time else 1
        if block and len(block) + together > size:
            yield block
            block = []
        block.append(frame)
    if block:
        yield block
