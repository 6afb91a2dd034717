"""Small valid scene files of every plan and kind of layer."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msdgs_export.bake import bake
from msdgs_export.importers.sequence import Frames, sequence_scene
from msdgs_export.plans.registry import build
from msdgs_export.storage.choice import COARSEST, GROUPS, packed
from msdgs_export.trajectories.sampling import Trajectories
from tests.support.models import NODES, SCENE, SHADING, random_model
from tests.support.scene_files import write_scene
from tests.support.splat_files import some_gaussians

MODELS: dict[str, dict[str, Any]] = {
    "mlp": {"layers": ("mlp", "mlp")},
    "plane": {"layers": ("plane",)},
    "hash4d": {"layers": ("hash4d",), "scale_space": "linear", "weights": False, "embedding_dim": 0},
    "mixed": {"layers": ("mlp", "plane"), "scale_space": "linear", "modulation_targets": ("means", "scales", "quats")},
    "spline on nodes": {"layers": ("spline",), "support": NODES},
    "hash4d on nodes": {"layers": ("hash4d", "spline"), "support": NODES},
    "mixed on nodes": {"layers": ("plane", "spline", "mlp"), "support": NODES, "weights": False, "embedding_dim": 0},
    "shading on nodes": {"layers": (SHADING, "mlp"), "support": NODES, "embedding_dim": 0},
    "static": {"layers": ()},
    **{
        f"all heads of {kind}": {"layers": (kind,), "opacity_head": True, "sh_head": True}
        for kind in ("mlp", "plane", "hash4d")
    },
}
PLANS = ("network", "prefix:1", "compact:40", "compact:60")
RESOLVED = 1e-4
"""Of the samples of motion: with the exporter's own, sampling takes most of the time, and graphs differ less."""

BY_HAND: dict[str, dict[str, Any]] = {
    "without steps": {},
    "with steps": {"steps": True},
    "opacities and colors that change": {"changing": ("opacities", "sh")},
}

OLDER = Path(__file__).parents[1] / "scene" / "older"
"""Files of older exporters."""

COUNT, PACKED_COUNT = 20, 100
"""Gaussians of each scene: arrays of fewer than 256 values aren't packed."""


@cache
def sound_scenes() -> dict[str, bytes]:
    """Scene files by name."""
    older = ((f"older {path.stem}", path.read_bytes()) for path in sorted(OLDER.glob("*.onnx")))
    return dict([*_exported(), *_packed(), *_of_sequences(), *_by_hand(), *older])


def _exported() -> Iterator[tuple[str, bytes]]:
    for name, config in MODELS.items():
        baked = bake(random_model(COUNT, **config), SCENE, "0" * 64)
        every_plan = config["layers"] and not baked.scene.changing
        trajectories = Trajectories(baked, resolved=RESOLVED) if every_plan else None
        for plan in PLANS if every_plan else PLANS[:1]:
            yield f"{name} {plan}", build(plan, baked, trajectories).SerializeToString()


def _packed() -> Iterator[tuple[str, bytes]]:
    """Arrays in the coarsest and the finest kinds of storage, unfolded by nodes."""
    finest = {name: list(group.kinds)[-1] for name, group in GROUPS.items()}
    for name, plan in (
        ("mlp", "network"),
        ("hash4d", "network"),
        ("mixed on nodes", "network"),
        ("shading on nodes", "network"),
        ("mixed", "compact:60"),
        ("static", "network"),
    ):
        baked = bake(random_model(PACKED_COUNT, **MODELS[name]), SCENE, "0" * 64)
        fitted = Trajectories(baked, resolved=RESOLVED) if plan != "network" else None
        contents = build(plan, baked, fitted)
        for kinds in (COARSEST, finest):
            yield f"{name} {plan}, packed in {kinds['quats']}", packed(contents, kinds).SerializeToString()


def _of_sequences() -> Iterator[tuple[str, bytes]]:
    for name, counts, seed in (
        ("blended frames", (COUNT, COUNT), 0),
        ("blended frames of other colors", (COUNT, COUNT), 1),
        ("switched frames", (COUNT, COUNT - 1), 0),
    ):
        frames = tuple(some_gaussians(count, seed=i * seed) for i, count in enumerate(counts))
        sequence = Frames(frames, 0, "dilate", blended=name.startswith("blended"))
        yield name, sequence_scene(sequence, "0" * 64).SerializeToString()


def _by_hand() -> Iterator[tuple[str, bytes]]:
    """Written without the exporter, in another version of the operator set, with nodes for constant outputs."""
    with TemporaryDirectory() as folder:
        for name, changes in BY_HAND.items():
            yield f"by hand, {name}", write_scene(Path(folder) / "scene.onnx", **changes).read_bytes()
