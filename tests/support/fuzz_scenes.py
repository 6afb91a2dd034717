"""Mutated scene files by seed, opened, posed and rendered. As a program it renders the valid scenes of FOLDER, opens
MARKER, then tests FILES mutated ones.

`python -m tests.support.fuzz_scenes FOLDER MARKER`
"""

import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import Camera, SceneFileInvalid
from msdgs_serve.scene.camera import orbit
from msdgs_serve.scene.onnx import GraphLimits
from tests.support.fuzzing import CASES, SEED
from tests.support.scene_files import UP
from tests.support.scene_mutations import mutated

FILES = 5 * CASES
LIMITS = GraphLimits(memory_bytes=64 << 20, operations=1e10, call_operations=1e10)
CAMERA = Camera.from_fov(orbit(np.zeros(3), 5.0, 30, 20, UP), 16, 16, 40.0)
DRAWN = "drawn"


def hostile_file(scenes: Mapping[str, bytes], seed: int) -> bytes:
    """Return the mutated file of a seed, made of one of these valid scenes."""
    rng = np.random.default_rng([33, seed])
    names = sorted(scenes)
    return mutated(scenes[names[seed % len(names)]], rng)


def outcome(contents: bytes) -> str:
    """Return `drawn` if all rendered frames are finite, or the reason for which the file is refused."""
    try:
        session = DeformationSession("mutated.onnx", contents=contents, limits=LIMITS)
        t0, t1 = session.scene.metadata.time_range
        images = [Renderer(0).render(session, CAMERA, t0 + (t1 - t0) * part) for part in (0.0, 0.37, 1.0)]
    except SceneFileInvalid as error:
        return reason(error)
    for image in images:
        assert np.isfinite(image.rgb).all()
        assert np.isfinite(image.alpha).all()
    return DRAWN


def reason(error: SceneFileInvalid) -> str:
    """Return the reason of a refusal; it must be short printable text."""
    shown = f"{error.field} {error.problem}"
    assert error.problem
    assert shown.isprintable()
    assert len(shown) < 1000
    return error.problem


def outcomes(scenes: Mapping[str, bytes]) -> Counter[str]:
    """Count the outcomes of `FILES` mutated files; a failure names its seed."""
    counted: Counter[str] = Counter()
    for seed in range(SEED, SEED + FILES):
        try:
            counted[outcome(hostile_file(scenes, seed))] += 1
        except Exception as error:
            raise AssertionError(f"the file of seed {seed} is neither refused nor drawn") from error
    return counted


def main(folder: str, marker: str) -> None:
    """Render the valid files, open the marker, then test the mutated files."""
    scenes = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    for contents in scenes.values():
        assert outcome(contents) == DRAWN
    Path(marker).read_bytes()
    print(f"{outcomes(scenes)[DRAWN]} drawn")


if __name__ == "__main__":
    main(*sys.argv[1:])
