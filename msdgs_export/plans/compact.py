"""Plan `compact:d`: motion in few bytes, with a predicted error of d dB in frames.

Each Gaussian stores coefficients of shared functions of time, or control points of a spline of its own: how many is
decided by rate-distortion optimization, the fewest bytes within the squared error of d dB. A frame is one product per
number of coefficients.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto

from msdgs_export.bake import Baked
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.plans.base import Plan, PlanSpec
from msdgs_export.plans.scene_graph import activated, finished
from msdgs_export.target import squared
from msdgs_export.trajectories.levels import LEADING, OWN, RANKS, Errors, Levels, sizes
from msdgs_export.trajectories.poses import MEANS, POSE, QUATS, SCALES
from msdgs_export.trajectories.sampling import Ids, Trajectories
from msdgs_export.trajectories.splines import time_weights
from msdgs_export.trajectories.stored import GriddedPoses, StoredPoses, at_time
from msdgs_train.evaluation.metrics import psnr_from_mse

BISECTIONS, SAMPLED = 20, 8192
"""Steps of the search for the multiplier, and number of Gaussians by which the highest rank is chosen."""

LOG_MULTIPLIERS = -24.0, 3.0
"""Decimal logarithms between which the Lagrange multiplier is searched, squared error per byte."""

DIVISOR = 10.0
"""The multiplier is divided by this while too few Gaussians have been tried with splines of their own."""


class Choice(NamedTuple):
    """What each of M Gaussians stores."""

    ranks: Ids  # [M] coefficients; -1: a spline of its own
    own: Ids  # [M] index in `OWN`; -1: none
    errors: Errors  # [M] what each adds to the squared error of a frame


def compact(baked: Baked, spec: PlanSpec, trajectories: Trajectories) -> onnx.ModelProto:
    """The scene with a predicted motion error of `spec.count` dB, or the smallest there is."""
    levels, rows = trajectories.once(Levels), trajectories.rows
    assert spec.count is not None
    choice = chosen(levels, rows, squared(spec.count))
    graph, time_range = GraphBuilder(), baked.scene.metadata.time_range
    ranks = [int(rank) for rank in np.unique(choice.ranks) if rank > 0]
    own = _own_poses(levels, rows, choice)
    parts = _products(graph, levels, rows, choice, ranks, time_range) if ranks else []
    parts += [at_time(graph, own, time_range)] if len(own) else []
    parts.append(graph.constant("motion.none", np.zeros((1, POSE), np.float32)))  # of all others
    moved = graph.node("Concat", parts, "motion.parts", axis=0)
    order = np.concatenate([*(np.flatnonzero(choice.ranks == rank) for rank in ranks), own.order])
    places = np.full(len(rows), len(order), np.int32)
    places[order] = np.arange(len(order), dtype=np.int32)
    indices = graph.node("Cast", [graph.constant("motion.places", places)], "motion.rows", to=TensorProto.INT64)
    columns = {"mean.means": MEANS, "mean.scales": SCALES, "mean.quats": QUATS}
    means = [graph.constant(name, levels.means[rows][:, part]) for name, part in columns.items()]
    mean = graph.node("Concat", means, "mean.poses", axis=1)
    activated(graph, graph.node("Add", [graph.node("Gather", [moved, indices], "motion.of_each"), mean], "poses"))
    fitted = {
        "psnr": psnr_from_mse(float(choice.errors.sum())),
        "own_poses": len(own),
        "too_fast": len(trajectories.unresolved),
    }
    return finished(graph, baked, str(spec), fitted)


def chosen(levels: Levels, rows: Ids, allowed: float) -> Choice:
    """The choice with the fewest bytes whose squared errors sum to `allowed` at most, or the smallest sum.

    Splines of their own are tried for Gaussians whose Lagrangian is above that of the spline's bytes alone.
    """
    ranks, rates, every = levels.num_ranks, sizes(levels.num_ranks), np.arange(len(rows))
    errors = np.full((len(rates), len(rows)), np.inf)
    errors[:ranks] = levels.errors[:, rows]
    # from what shared functions reach
    _, multiplier = _fewest_bytes(errors, rates, levels, max(allowed, 2 * errors[ranks - 1].sum()))
    while True:
        for level in ranks + np.argsort(rates[ranks:], kind="stable"):
            lagrangian = (errors + multiplier * rates[:, None]).min(axis=0)
            tried = np.flatnonzero((lagrangian > multiplier * rates[level]) & np.isinf(errors[level]))
            errors[level, tried] = levels.own_errors(rows[tried], level - ranks)
        picked, _ = _fewest_bytes(errors, rates, levels, allowed)
        multiplier /= DIVISOR
        if errors[picked, every].sum() <= allowed or multiplier < 10 ** LOG_MULTIPLIERS[0]:
            break
    is_own = picked >= ranks
    counts = np.array(RANKS)[picked.clip(0, ranks - 1)]
    return Choice(np.where(is_own, -1, counts), np.where(is_own, picked - ranks, -1), errors[picked, every])


def _fewest_bytes(errors: Errors, rates: npt.NDArray[np.float64], levels: Levels, allowed: float) -> tuple[Ids, float]:
    """[M] levels, and the multiplier by which they are chosen; functions are stored up to the highest rank. Some of the
    Gaussians decide which that is, or a higher one if all need it: errors are the smaller, the more ranks there are."""
    some = errors[:, :: -(-errors.shape[1] // SAMPLED)]
    share, last = some.shape[1] / errors.shape[1], levels.num_ranks - 1

    def size(top: int) -> float:
        picked, _, error = _up_to(top, some, rates, levels.num_ranks, allowed * share)
        whole = rates[picked].sum() + share * RANKS[top] * levels.bytes_per_function
        return whole if error <= allowed * share else math.inf

    for top in range(min(range(last, -1, -1), key=size), last):  # the last one if no sum is small enough
        picked, multiplier, error = _up_to(top, errors, rates, levels.num_ranks, allowed)
        if error <= allowed:
            return picked, multiplier
    return _up_to(last, errors, rates, levels.num_ranks, allowed)[:2]


def _up_to(
    top: int, errors: Errors, rates: npt.NDArray[np.float64], num_ranks: int, allowed: float
) -> tuple[Ids, float, float]:
    """[M] levels with no rank above `top`, the multiplier, and the sum of errors."""
    among, (low, high), every = np.r_[: top + 1, num_ranks : len(rates)], LOG_MULTIPLIERS, np.arange(errors.shape[1])
    some = errors[among]

    def pick(exponent: float) -> tuple[Ids, float]:
        picked = (some + 10**exponent * rates[among, None]).argmin(axis=0)
        return among[picked], some[picked, every].sum()

    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if pick(middle)[1] <= allowed else (low, middle)
    picked, error = pick(low)
    return picked, 10**low, error


def _products(
    graph: GraphBuilder, levels: Levels, rows: Ids, choice: Choice, ranks: list[int], time_range: tuple[float, float]
) -> list[str]:
    """Displacements of the Gaussians of each rank from their mean poses: coefficients times functions at `t`."""
    name = "functions"
    cells, weights = time_weights(graph, f"{name}.clock", time_range, [levels.knots])
    near = graph.node("Add", [cells, graph.constant(f"{name}.neighbors", np.arange(4, dtype=np.int64))], f"{name}.near")
    control = levels.functions[:, : ranks[-1]].reshape(levels.knots, -1)
    control = graph.node("Gather", [graph.constant(f"{name}.control", control), near], f"{name}.points")
    shape = graph.constant(f"{name}.shape", np.array([-1, POSE], np.int64))
    functions = graph.node("Reshape", [graph.node("MatMul", [weights, control], f"{name}.flat"), shape], f"{name}.now")
    parts = []
    for rank in ranks:
        name, values = f"coefficients{rank}", levels.coefficients[rows[choice.ranks == rank], :rank]
        stored = [graph.constant(f"{name}.leading", values[:, :LEADING])]
        stored += [graph.constant(f"{name}.rest", values[:, LEADING:])] if rank > LEADING else []
        first = graph.constant(f"{name}.first", np.arange(rank, dtype=np.int64))
        factors = [graph.node("Concat", stored, name, axis=1), graph.node("Gather", [functions, first], f"{name}.now")]
        parts.append(graph.node("MatMul", factors, f"{name}.moved"))
    return parts


def _own_poses(levels: Levels, rows: Ids, choice: Choice) -> GriddedPoses:
    """Splines of their own, relative to the mean poses."""
    grids = []
    for index in np.unique(choice.own[choice.own >= 0]):
        ids, (count, bits) = np.flatnonzero(choice.own == index), OWN[index]
        grids.append((ids, StoredPoses.of(levels.own(rows[ids], count), bits)))
    return GriddedPoses(tuple(grids))


COMPACT = Plan(
    "compact",
    "compact:d, motion with a predicted error of d dB, 20 to 90",
    "#a463f2",
    lambda baked, spec, sample: compact(baked, spec, sample()),
    candidates=lambda layers: [f"compact:{db}" for db in (72, 66, 63, 60, 56, 52, 46, 40)],
    counts=range(20, 91),
    fitted=True,
)
