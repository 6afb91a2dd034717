"""Blocks of frames on a Ray cluster. A scene's file goes into the object store once, and to each machine once."""

import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_serve.blocks import Block, OutputOptions, draw_block
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.ray_tasks import RayTasks, in_turns
from msdgs_serve.renderer import Renderer
from msdgs_serve.threads import THREADS_VARIABLE

OPEN_SCENES = 2
"""That a worker keeps: blocks come scene by scene, and while one ends the next begins."""


def draw_on_ray(blocks: Sequence[Block], look: OutputOptions, cores: int) -> Iterator[tuple[int, bytes]]:
    """Number and file contents of each frame, block by block as they end. One core draws one block.

    Needs a connection, `ray_cluster`. Raises `MsdgsError` for what can't be drawn.
    """
    import ray  # pyright: ignore[reportMissingImports]

    scenes = {block.scene: None for block in blocks}
    # an array, which workers of one machine see without copies
    stored = {scene: ray.put(np.frombuffer(scene.read_bytes(), np.uint8)) for scene in scenes}
    tasks: RayTasks[Block, list[tuple[int, bytes]]] = RayTasks(_draw, stored, look)
    for _, frames in in_turns(tasks, list(blocks), cores):
        yield from frames


def _draw(stored: dict[Path, Any], look: OutputOptions, block: Block) -> list[tuple[int, bytes]]:
    os.environ[THREADS_VARIABLE] = "1"  # other blocks have the other cores
    session, renderer = _opened(block.scene, stored[block.scene])
    return list(draw_block(block, session, renderer, look))


@lru_cache(OPEN_SCENES)
def _opened(name: Path, contents: Any) -> tuple[DeformationSession, Renderer]:
    import ray  # pyright: ignore[reportMissingImports]

    return DeformationSession(name, contents=ray.get(contents).tobytes()), Renderer()
