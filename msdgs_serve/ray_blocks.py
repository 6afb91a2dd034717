"""Draw blocks of frames on a Ray cluster. A scene file is put into the object store once and sent to a machine once."""

import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_serve.blocks import Block, OutputOptions, draw_block
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.ray_tasks import RayTasks, run_tasks
from msdgs_serve.renderer import Renderer
from msdgs_serve.threads import THREADS_VARIABLE

OPEN_SCENES = 2
"""Scenes that a worker keeps open: blocks are sorted by scene, and one scene's last overlap the next one's first."""


def draw_on_ray(blocks: Sequence[Block], look: OutputOptions, cores: int) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the encoded file of each frame as blocks finish. Each block is drawn on one core.

    Call it within `ray_cluster`. Raises `MsdgsError` if a frame can't be drawn.
    """
    import ray  # pyright: ignore[reportMissingImports]

    scenes = {block.scene: None for block in blocks}
    # as arrays, which Ray shares between the workers of a machine without copies
    stored = {scene: ray.put(np.frombuffer(scene.read_bytes(), np.uint8)) for scene in scenes}
    tasks: RayTasks[Block, list[tuple[int, bytes]]] = RayTasks(_draw, stored, look)
    for _, frames in run_tasks(tasks, list(blocks), cores):
        yield from frames


def _draw(stored: dict[Path, Any], look: OutputOptions, block: Block) -> list[tuple[int, bytes]]:
    os.environ[THREADS_VARIABLE] = "1"  # other cores draw other blocks
    session, renderer = _opened(block.scene, stored[block.scene])
    return list(draw_block(block, session, renderer, look))


@lru_cache(OPEN_SCENES)
def _opened(name: Path, contents: Any) -> tuple[DeformationSession, Renderer]:
    import ray  # pyright: ignore[reportMissingImports]

    return DeformationSession(name, contents=ray.get(contents).tobytes()), Renderer()
