"""A slow, obvious deformation in NumPy and float64: layers, chains, and linear blend skinning."""

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.bodies import BodiesLayer
from msdgs_train.layers.curves import CurveLayer
from msdgs_train.layers.hash4d import Hash4DLayer
from msdgs_train.layers.hash_grid import HashGrid
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.plane import PlaneGrid, PlaneLayer
from msdgs_train.layers.spline import SplineLayer
from msdgs_train.supports.nodes import NodesSupport

MIN_STRETCH = 0.05


class PlainDeltas(NamedTuple):
    """Deltas of N points, and the weight of a step."""

    means: np.ndarray  # [N, 3]
    scales: np.ndarray  # [N, 3], or [N, 6] of a stretch tensor
    quats: np.ndarray  # [N, 4] wxyz
    weight: np.ndarray | float = 1.0  # [N, 1]


class PlainPose(NamedTuple):
    """N Gaussians at one time."""

    means: np.ndarray  # [N, 3]
    scales: np.ndarray  # [N, 3] linear
    quats: np.ndarray  # [N, 4] wxyz, unit


def array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().double().numpy()


def linear(module: torch.nn.Module, value: np.ndarray) -> np.ndarray:
    assert isinstance(module, torch.nn.Linear)
    return value @ array(module.weight).T + array(module.bias)


def plain_encoding(x: np.ndarray, frequencies: int) -> np.ndarray:
    phases = [x * 2.0**k for k in range(frequencies)]
    return np.concatenate([x, *(np.sin(p) for p in phases), *(np.cos(p) for p in phases)], axis=-1)


def plain_hidden(layer: MLPLayer, means: np.ndarray, t: float) -> np.ndarray:
    """Equations 7 and 10: [N, width] the last hidden units, with the time features repeated for every point."""
    time = plain_encoding(np.array([[t]]), layer.time_frequency_matrix.shape[1])
    code = linear(layer.time_output, np.maximum(linear(layer.time_hidden, time), 0))
    encoded = plain_encoding(means, layer.xyz_frequency_matrix.shape[1] // 3)
    inputs = np.concatenate([encoded, np.repeat(code, len(means), axis=0)], axis=1)
    hidden = np.maximum(linear(layer.first, inputs), 0)
    for i, module in enumerate(layer.trunk, start=1):
        read = np.concatenate([inputs, hidden], axis=1) if i == layer.skip else hidden
        hidden = np.maximum(linear(module, read), 0)
    return hidden


def plain_features(planes: PlaneGrid, means: np.ndarray, t: float) -> np.ndarray:
    """[N, C] products of six planes, each interpolated by hat functions."""
    space, time = array(planes.space), array(planes.time)
    size, times = space.shape[1], time.shape[1]
    features = np.ones((len(means), space.shape[3]))
    for n, mean in enumerate(means):
        cells = mean * array(planes.cells) + (size - 1) / 2
        place = (t - array(planes.first_time)) * array(planes.time_cells)
        positions = [*np.clip(cells, 0, size - 1), np.clip(place, 0, times - 1)]
        counts = (size, size, size, times)
        hats = [np.maximum(0, 1 - abs(p - np.arange(count))) for p, count in zip(positions, counts, strict=True)]
        for plane, (a, b) in enumerate([(0, 1), (0, 2), (1, 2)]):
            features[n] *= np.einsum("i,j,ijc->c", hats[a], hats[b], space[plane])
        for axis in range(3):
            features[n] *= np.einsum("t,j,tjc->c", hats[3], hats[axis], time[axis])
    return features


def plain_plane(layer: PlaneLayer, means: np.ndarray, t: float) -> np.ndarray:
    """Equation 11: the columns of all heads."""
    read = np.concatenate([plain_features(grid, means, t) for grid in layer.plane_grids()], axis=1)
    features = np.maximum(linear(layer.features, read), 0)
    heads = zip(layer.hidden, layer.heads, strict=True)
    return np.concatenate([linear(head, np.maximum(linear(hidden, features), 0)) for hidden, head in heads], axis=1)


def plain_curves(layer: CurveLayer, curves: list[torch.Tensor], t: float) -> np.ndarray:
    """[C, ·] values of uniform cubic B-splines side by side."""
    count = layer.num_knots
    first, length = float(layer.first_time), count / float(layer.knots_per_time)
    knots = first + np.arange(-3, count + 4) / count * length
    values = np.concatenate([array(curve) for curve in curves], axis=2)
    return BSpline(knots, values, 3)(np.clip(t, first, first + length))


def plain_bodies(layer: BodiesLayer, means: np.ndarray, t: float) -> PlainDeltas:
    """Each body turns a node about its center and shifts it; the node takes the mean by softmax."""
    poses, centers, logits = (
        plain_curves(layer, [layer.transls, layer.rots], t),
        array(layer.centers),
        array(layer.logits),
    )
    shifts, turns = np.zeros((len(means), 3)), np.zeros((len(means), 4))
    for m, mean in enumerate(means):
        weights = np.exp(logits[m]) / np.exp(logits[m]).sum()
        for weight, pose, center in zip(weights, poses, centers, strict=True):
            moved = rotation(pose[3:]).apply(mean - center) + center + pose[:3]
            shifts[m] += weight * (moved - mean)
            turns[m] += weight * (pose[3:] / np.linalg.norm(pose[3:]) - [1, 0, 0, 0])
    return PlainDeltas(shifts, np.zeros((len(means), 3)), turns)


def plain_hash_features(grid: HashGrid, places: np.ndarray) -> np.ndarray:
    """[N, L · C] features of places in the unit cube, [N, 3], node by node; zeros outside."""
    levels, table = grid.levels, array(grid.table)
    features = np.zeros((len(places), len(levels.nodes), table.shape[1]))
    for n, place in enumerate(places):
        if not all(0 <= axis <= 1 for axis in place):
            continue
        for level, (scale, nodes) in enumerate(zip(levels.scales.astype(np.float64), levels.nodes, strict=True)):
            rows = int(levels.starts[level + 1] - levels.starts[level])
            low = np.minimum(np.floor(place * scale), nodes - 2)
            for corner in itertools.product((0, 1), repeat=3):
                x, y, z = (int(index) for index in low + corner)
                row = x + int(nodes[0]) * (y + int(nodes[1]) * z)
                if np.prod(nodes) > rows:
                    row = (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % rows
                distances = np.abs(place * scale - (x, y, z))
                weight = np.prod(1 - distances**2 * (3 - 2 * distances))  # symmetric about the middle of a cell
                features[n, level] += weight * table[levels.starts[level] + row]
    return features.reshape(len(places), -1)


def plain_hash4d(layer: Hash4DLayer, means: np.ndarray, t: float) -> np.ndarray:
    """The columns of all heads, after a turn about the origin as part of the deltas of means."""
    half = array(layer.half_sizes)
    space = (means / half + 1) / 2
    time = np.full(len(means), 0.05 + 0.9 * (t - float(layer.first_time)) / float(layer.duration))
    read = [
        plain_hash_features(grid, np.stack([space[:, a], space[:, b], time], axis=1))
        for grid, (a, b) in zip(layer.temporal, [(0, 1), (1, 2), (0, 2)], strict=True)
        if isinstance(grid, HashGrid)
    ]
    hidden = np.maximum(linear(layer.from_temporal, np.concatenate(read, axis=1)), 0)
    factors = 1 / (1 + np.exp(-linear(layer.from_canonical, plain_hash_features(layer.canonical, space))))
    hidden = hidden * (2 * factors - 1)
    for module in layer.hidden:
        hidden = np.maximum(linear(module, hidden), 0)
    columns = linear(layer.heads, hidden)
    turned = rotation(columns[:, :4] + [1, 0, 0, 0]).apply(means) if len(means) else means
    return np.concatenate([turned + columns[:, 4:7] - means, columns[:, 7:]], axis=1)


def plain_step(layer: DeformationLayer, means: np.ndarray, t: float) -> PlainDeltas:
    """One layer, of a kind of this package, at points [N, 3]."""
    if isinstance(layer, BodiesLayer):
        return plain_bodies(layer, means, t)
    if isinstance(layer, SplineLayer):
        curves = [layer.transls, layer.rots, layer.stretches]
        transls, rots, stretches = np.split(plain_curves(layer, curves, t), [3, 7], axis=1)
        return PlainDeltas(transls, stretches, rots - [1, 0, 0, 0])
    if isinstance(layer, Hash4DLayer):
        columns = plain_hash4d(layer, means, t)
    else:
        assert isinstance(layer, MLPLayer | PlaneLayer)
        is_mlp = isinstance(layer, MLPLayer)
        columns = linear(layer.heads, plain_hidden(layer, means, t)) if is_mlp else plain_plane(layer, means, t)
    weight = 1 / (1 + np.exp(-columns[:, 10:])) if layer.outputs.weight else 1.0
    return PlainDeltas(columns[:, :3], columns[:, 3:6], columns[:, 6:10], weight)


def plain_chain(layers: Iterable[DeformationLayer], means: np.ndarray, t: float) -> PlainDeltas:
    """Equations 7 to 9: each layer reads the means as moved by those before it."""
    n = len(means)
    total = PlainDeltas(np.zeros((n, 3)), np.zeros((n, 6)), np.zeros((n, 4)))
    for layer in layers:
        step = plain_step(layer, means + total.means, t)
        scales = np.pad(step.scales, ((0, 0), (0, 6 - step.scales.shape[1])))
        deltas = zip(total[:3], (step.means, scales, step.quats), strict=True)
        total = PlainDeltas(*(old + step.weight * delta for old, delta in deltas))
    return total


def rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.asarray(wxyz)[..., [1, 2, 3, 0]])


def plain_motion(node: np.ndarray, deltas: PlainDeltas, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix, offset and unit quaternion of node k: x → matrix x + offset."""
    quat = deltas.quats[k] + [1, 0, 0, 0]
    xx, yy, zz, xy, xz, yz = deltas.scales[k]
    stretch = np.array([[1 + xx, xy, xz], [xy, 1 + yy, yz], [xz, yz, 1 + zz]])
    matrix = rotation(quat).as_matrix() @ stretch
    return matrix, node + deltas.means[k] - matrix @ node, quat / np.linalg.norm(quat)


def plain_pose(model: DynamicGaussians, t: float) -> PlainPose:
    """A model without modulation, posed Gaussian by Gaussian."""
    g = model.gaussians
    means, scales = array(g.means), np.exp(array(g.log_scales))
    quats = array(g.raw_quats)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    if isinstance(model.support, NodesSupport):
        return _skinned(model, model.support, PlainPose(means, scales, quats), t)
    deltas = plain_chain(model.deformation, means, t)
    moved = quats + deltas.quats
    unit = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    return PlainPose(means + deltas.means, scales * np.exp(deltas.scales[:, :3]), unit)


def _skinned(model: DynamicGaussians, support: NodesSupport, canonical: PlainPose, t: float) -> PlainPose:
    """Linear blend skinning: matrices, offsets and quaternions of the followed nodes are averaged by weight."""
    nodes = array(support.nodes)
    deltas = plain_chain(model.deformation, nodes, t)
    motions = [plain_motion(node, deltas, k) for k, node in enumerate(nodes)]
    logits, ids = array(model.gaussians.attributes["skinning_logits"]), model.gaussians.attributes["node_ids"].numpy()
    means, scales, quats = (np.empty_like(values) for values in canonical)
    for n, (mean, scale, quat) in enumerate(zip(*canonical, strict=True)):
        weights = np.exp(logits[n] - logits[n].max())
        followed = [motions[k] for k in ids[n]]
        matrix, offset, rot = (np.average(parts, axis=0, weights=weights) for parts in zip(*followed, strict=True))
        means[n] = matrix @ mean + offset
        scales[n] = scale * np.maximum(np.linalg.norm(matrix @ rotation(quat).as_matrix(), axis=0), MIN_STRETCH)
        quats[n] = (rotation(rot) * rotation(quat)).as_quat()[[3, 0, 1, 2]]
    return PlainPose(means, scales, quats)
