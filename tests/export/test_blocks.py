"""Blocks of Gaussians on control nodes: every Gaussian keeps its nodes and weights, whatever the order."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from onnx import numpy_helper

from msdgs_export.bake import bake
from msdgs_export.importers.sequence import Frames, sequence_scene
from msdgs_export.plans.registry import build
from msdgs_export.spatial_order import morton_order
from msdgs_export.supports.blocks import block_layout
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import SceneFileInvalid
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.spline import SplineLayer
from tests.support.models import NODES, SCENE, SPLINE, random_model
from tests.support.splat_files import some_gaussians
from tests.support.tolerances import tolerance


def skinning(count: int, nodes: int, follows: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, the nearest of some nodes at random places, and weights that sum to 1."""
    rng = np.random.default_rng(seed)
    means, places = rng.random((count, 3), np.float32), rng.random((nodes, 3), np.float32)
    distances = np.linalg.norm(means[:, None] - places, axis=2)
    weights = rng.random((count, follows)) + 1e-3
    return means, np.argsort(distances, axis=1)[:, :follows], weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("count", "nodes", "follows"), [(1, 1, 1), (5, 3, 3), (257, 40, 4), (1000, 300, 8), (64, 900, 8)]
)
def test_each_row_has_the_nodes_and_weights_of_its_gaussian(count: int, nodes: int, follows: int):
    means, node_ids, weights = skinning(count, nodes, follows)
    layout = block_layout(means, node_ids, weights)
    stored = layout.attributes
    assert set(layout.rows) == set(range(count))
    blocks, size, _ = stored["ids"].shape
    dense = np.zeros((blocks * size, nodes))
    for block in range(blocks):
        for row in range(size):
            of_row = stored["nodes"][block][stored["ids"][block, row]]
            np.add.at(dense[block * size + row], of_row, stored["weights"][block, row])
    want = np.zeros((count, nodes))
    np.put_along_axis(want, node_ids, weights, axis=1)
    np.testing.assert_allclose(dense, want[layout.rows], atol=tolerance("float32.relative"))
    assert stored["weights"][..., :-1].max(initial=0) <= 0.5


def test_morton_order_of_a_grid_visits_each_octant_at_once():
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    shuffled = grid[np.random.default_rng(1).permutation(64)]
    octants = (shuffled[morton_order(shuffled)] // 2) @ np.array([1, 2, 4])
    np.testing.assert_array_equal(octants, np.repeat(np.arange(8), 8))


@pytest.mark.parametrize("means", [np.zeros((0, 3), np.float32), np.full((3, 3), 2.0, np.float32)])
def test_morton_order_of_points_without_extent(means: np.ndarray):
    np.testing.assert_array_equal(morton_order(means), np.arange(len(means)))


def session_of(model: DynamicGaussians) -> DeformationSession:
    """The model's scene file, opened."""
    contents = build("network", bake(model, SCENE, "0" * 64)).SerializeToString()
    return DeformationSession("nodes.onnx", contents=contents)


def test_a_scene_on_nodes_is_posed_in_one_call():
    """For any number of Gaussians, any ids and any number of layers."""
    count = 5000
    model = random_model(count, noise=0.02, support=replace(NODES, num_nodes=30), sh_degree=0)
    session = session_of(model)
    assert session.cost.calls == 1
    ids = np.random.default_rng(2).permutation(count)[:700]
    for steps, layers in ((None, None), (1.0, 1), (0.0, 0)):
        with torch.no_grad():
            posed = model.pose(0.3, layers, ids=torch.from_numpy(ids))
        for got, want in zip(session.pose(0.3, ids, steps), (posed.means, posed.quats, posed.scales), strict=True):
            np.testing.assert_allclose(got, want.numpy(), rtol=0, atol=tolerance("export.relative"))
    for some, every in zip(session.pose(0.3, ids), session.pose(0.3), strict=True):
        np.testing.assert_array_equal(some, every[ids])
    assert [part.shape for part in session.pose(0.3, [])] == [(0, 3), (0, 4), (0, 3)]


def test_a_graph_of_all_gaussians_is_not_run_if_none_of_them_moves(monkeypatch: pytest.MonkeyPatch):
    """A file whose `ids` are emptied still has the rows of all in its graph, which its cost of 0 calls hides."""
    frames = tuple(some_gaussians(300, seed=i) for i in range(2))
    model = sequence_scene(Frames(frames, 0, "dilate", blended=True), "0" * 64)
    for constant in model.graph.initializer:
        if constant.name in ("ids", "opacities", "sh"):
            constant.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(constant)[:0], constant.name))
    monkeypatch.setattr(DeformationSession, "_run", lambda *_: pytest.fail("the graph was run"))
    session = DeformationSession("hostile.onnx", contents=model.SerializeToString())
    assert session.cost.calls == 0
    assert not any(len(part) for part in session.pose(0.3))


def test_a_graph_without_ids_says_how_many_gaussians_it_poses():
    model = build("network", bake(random_model(300, support=NODES, sh_degree=0), SCENE, "0" * 64))
    assert [given.name for given in model.graph.input] == ["t", "steps"]
    means = next(each for each in model.graph.output if each.name == "means").type.tensor_type.shape.dim[0]
    assert means.dim_value == 300
    for wrong in (299, 301, 0, 1 << 40):
        means.dim_value = wrong
        with pytest.raises(SceneFileInvalid):
            DeformationSession("hostile.onnx", contents=model.SerializeToString())
    means.dim_param = "M"
    with pytest.raises(SceneFileInvalid, match="`ids` is missing from the inputs, and `means` has no fixed number"):
        DeformationSession("hostile.onnx", contents=model.SerializeToString())


@pytest.mark.parametrize("embedding_dim", [0, 8])
def test_rotations_that_cancel_are_the_identity(embedding_dim: int):
    """With and without modulation, as in training: such a blend has no direction."""
    model = random_model(20, layers=(SPLINE,), support=NODES, embedding_dim=embedding_dim)
    layer = model.deformation.layers[0]
    assert isinstance(layer, SplineLayer)
    with torch.no_grad():
        layer.rots.zero_()
        want = model.pose(0.3)
    session = session_of(model)
    for got, values in zip(session.pose(0.3), (want.means, want.quats, want.scales), strict=True):
        np.testing.assert_allclose(got, values.numpy(), rtol=0, atol=tolerance("export.relative"))
    np.testing.assert_allclose(session.pose(0.3)[1], np.tile([1, 0, 0, 0], (20, 1)), atol=1e-6)
