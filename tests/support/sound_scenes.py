"""Sound scene files of every plan and every kind of layer, small."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from export.importers.sequence import Frames, sequence_scene
from export.jobs.bake import bake
from export.plans.registry import build
from tests.support.models import SCENE, random_model
from tests.support.scene_files import write_scene
from tests.support.splat_files import some_gaussians

LAYERS = {"mlp": ("mlp", "mlp"), "plane": ("plane",), "bases": ("bases",), "mixed": ("mlp", "plane"), "static": ()}
PLANS = ("network", "prefix:1", "int8", "lowrank:4", "lowrank:0.05", "keyframes:8", "keyframes:0.05")
WITHOUT_INT8 = ("plane", "bases")
"""No product of theirs is of width × width."""

COUNT = 20
"""Gaussians of each."""


@cache
def sound_scenes() -> dict[str, bytes]:
    """By name."""
    return dict([*_exported(), *_of_sequences(), *_by_hand()])


def _exported() -> Iterator[tuple[str, bytes]]:
    for kind, layers in LAYERS.items():
        baked = bake(random_model(COUNT, layers=layers), SCENE, "0" * 64)
        for plan in PLANS if layers else PLANS[:1]:
            if plan != "int8" or kind not in WITHOUT_INT8:
                yield f"{kind} {plan}", build(plan, baked).SerializeToString()


def _of_sequences() -> Iterator[tuple[str, bytes]]:
    for name, counts in (("blended frames", (COUNT, COUNT)), ("switched frames", (COUNT, COUNT - 1))):
        frames = tuple(some_gaussians(count) for count in counts)
        sequence = Frames(frames, 0, "dilate", blended=name == "blended frames")
        yield name, sequence_scene(sequence, "0" * 64).SerializeToString()


def _by_hand() -> Iterator[tuple[str, bytes]]:
    """Written without the exporter, of another version of the operator set; constant outputs are computed."""
    with TemporaryDirectory() as folder:
        for steps in (False, True):
            yield (
                f"by hand, {'with' if steps else 'without'} steps",
                write_scene(Path(folder) / "scene.onnx", steps=steps).read_bytes(),
            )
