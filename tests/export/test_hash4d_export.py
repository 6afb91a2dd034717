"""The hash layer in scene files: features over space are constants of each Gaussian, in whatever order they come."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_export.bake import bake
from msdgs_export.layers import ModelNotExportable, hash4d
from msdgs_export.layers.hash4d import Hash4DExport
from msdgs_export.measure.poses import posed
from msdgs_export.plans.registry import build
from msdgs_export.pruning.mask import bake_pruned, full_mask, in_spatial_order, pruned
from msdgs_serve.deformation import DeformationSession
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.hash4d import Hash4DLayer
from tests.support.models import HASH4D, MLP, NODES, SCENE, random_model
from tests.support.tolerances import tolerance

TIMES = (0.0, 0.37, 1.0)
GRID4D: dict[str, Any] = {"layers": (HASH4D,), "weights": False, "embedding_dim": 0, "scale_space": "linear"}


def hashed(count: int = 40, noise: float = 0.2, **changes: Any) -> DynamicGaussians:
    """A model of which some Gaussians are outside of the grids."""
    model = random_model(count, noise=noise, **(GRID4D | changes))
    layer = model.deformation.layers[0]
    assert isinstance(layer, Hash4DLayer)
    layer.half_sizes.copy_(torch.tensor([1.2, 1.0, 1.3]))
    return model


def session(folder: Path, baked: Any, plan: str = "network") -> DeformationSession:
    (folder / "scene.onnx").write_bytes(build(plan, baked).SerializeToString())
    return DeformationSession(folder / "scene.onnx")


@pytest.mark.parametrize(
    "changes",
    [{}, {"weights": True, "embedding_dim": 4}, {"layers": (HASH4D, MLP)}, {"support": NODES, "scale_space": "log"}],
    ids=["grid4d", "weights", "chain", "nodes"],
)
def test_the_file_gives_the_poses_of_the_model(tmp_path: Path, changes: dict[str, Any]):
    model = hashed(noise=0.07 if changes.keys() & {"support", "layers"} else 0.2, **changes)
    scene = session(tmp_path, bake(model, SCENE, "0" * 64))
    moved = []
    for t in TIMES:
        got, want = scene.gaussians(t), posed(model, t)
        for part in ("means", "quats", "scales"):
            assert np.abs(getattr(got, part) - getattr(want, part)).max() <= tolerance("export.relative")
        moved.append(got.means)
    assert np.abs(moved[0] - moved[1]).max() > 10 * tolerance("export.relative")
    some = np.array([7, 0, 7, 31])
    if "support" not in changes:
        assert np.abs(scene.pose(0.37, some)[0] - moved[1][some]).max() <= tolerance("export.relative")


def test_constants_follow_the_gaussians_through_pruning_and_sorting(tmp_path: Path):
    model = hashed(60)
    whole = {t: posed(model, t) for t in TIMES}
    kept, moves = np.arange(60) % 3 > 0, np.arange(60) % 6 > 2
    ordered = in_spatial_order(model)
    order = [np.abs(whole[0.0].means - mean).sum(axis=1).argmin() for mean in posed(ordered, 0.0).means]
    assert order != sorted(order)
    mask = replace(full_mask(ordered), kept=kept[order], moves=(kept & moves)[order])
    scene = session(tmp_path, bake_pruned(pruned(ordered, mask, posed(ordered, 0.5), []), SCENE, "0" * 64))
    ids = np.array(order)[mask.moves]
    assert scene.scene.moving_count == len(ids) == 20
    for t in TIMES:
        assert np.abs(scene.gaussians(t).means[: len(ids)] - whole[t].means[ids]).max() <= tolerance("export.relative")


def test_heads_that_are_left_out_do_nothing():
    model, export = hashed(), Hash4DExport()
    (layer,) = model.deformation
    assert export.inert_heads(layer) == frozenset()
    for name, part in (("means", 0), ("scales", 1), ("quats", 2)):
        without = export.without_heads(layer, frozenset({name}))
        assert export.inert_heads(without) == {name}
        with torch.no_grad():
            step, whole = (each(model.gaussians.means, torch.tensor(0.4)) for each in (without, layer))
        assert [bool(delta.any()) for delta in step[:3]] == [k != part for k in range(3)]
        assert all(delta.any() for delta in whole[:3])


def test_a_layer_that_reads_moved_points_is_refused():
    config: dict[str, Any] = GRID4D | {"layers": (MLP, HASH4D)}
    model = random_model(5, **config)
    with pytest.raises(
        ModelNotExportable, match="layer 2 is of kind 'hash4d', which can only be exported as the first"
    ):
        build("network", bake(model, SCENE, "0" * 64))


def test_grids_with_too_many_nodes_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(hash4d, "MAX_ROWS", 100)
    with pytest.raises(ModelNotExportable, match="nodes over time, of which a scene file holds up to 100"):
        build("network", bake(hashed(5), SCENE, "0" * 64))
