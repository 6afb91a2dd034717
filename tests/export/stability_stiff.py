"""Constructed models whose layers amplify round-off: a little, a lot, and beyond the range of floats."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from msdgs_export.measure.amplification import through_layers
from msdgs_export.measure.poses import posed
from msdgs_export.precision.assess import assess
from msdgs_export.precision.report import StabilityReport
from msdgs_train.gaussians.model import DynamicGaussians
from tests.export.stability_rows import Change, Row, changed, measured, refused, worst_frame
from tests.support.models import MLP, NODES, PLANE, SCENE, SMALL_LAYERS
from tests.support.tolerances import tolerance

TIMES = 3
UNSEEN_TIMES = (0.137, 0.4321, 0.777)
"""None of them is one of the times of `assess`."""


def steps_times(factor: float, part: str = "heads") -> Change:
    """Scale a layer's last Linear by `factor`: steps, their Jacobian, and the weight's logit; or another `part`."""

    def change(model: DynamicGaussians) -> None:
        for name, parameter in model.deformation.named_parameters():
            if part in name and name.endswith("weight"):
                parameter *= factor

    return change


all_times = partial(steps_times, part="")


def rougher(factor: float) -> Change:
    """Scale the upper octaves, 32 to 512, by `factor`, with steps as large as before: a stiff field."""

    def change(model: DynamicGaussians) -> None:
        before = _displacement(model)
        for layer in model.deformation.layers:
            columns = layer.get_buffer("xyz_frequency_matrix").amax(dim=0) >= 32
            upper = torch.cat([torch.zeros(3, dtype=torch.bool), columns, columns])
            layer.get_parameter("first.weight")[:, : len(upper)][:, upper] *= factor
        steps_times(before / _displacement(model))(model)

    return change


def _displacement(model: DynamicGaussians) -> float:
    return float((model.pose(0.5).means - model.gaussians.means).norm(dim=1).median())


def saturated(logit: float) -> Change:
    """Set the weight's logit so that its sigmoid is exactly 0 or 1 in float32."""

    def change(model: DynamicGaussians) -> None:
        for layer in model.deformation.layers:
            layer.get_parameter("heads.bias")[-1] = logit

    return change


def nodes_at_one_place(model: DynamicGaussians) -> None:
    nodes = model.support.get_buffer("nodes")
    nodes[:] = nodes[0]


def follow_one_node(model: DynamicGaussians) -> None:
    """Set the skinning logits so that weights are exactly 0 and 1 in float32."""
    logits = model.gaussians.get_parameter("skinning_logits")
    logits.fill_(-200)[:, 0] = 200


def far_from_nodes(model: DynamicGaussians) -> None:
    """Move the first Gaussian 2 scene units away along each axis: rotations of its nodes move it as far."""
    model.gaussians.means[0] += 2


def flattened(model: DynamicGaussians) -> None:
    """Shrink the nodes' surroundings below the smallest stretch."""
    for layer in model.deformation.layers:
        layer.get_parameter("heads.bias")[3:6] = -1


def layers(count: int, kind: str = "mlp") -> dict[str, Any]:
    """Many layers are small ones: only their number matters here."""
    small = {"mlp": replace(MLP, depth=1), "plane": replace(PLANE, resolution=6, time_resolution=6)}
    return {"layers": ((small if count > 4 else SMALL_LAYERS)[kind],) * count}


CASES: dict[str, Callable[[], DynamicGaussians]] = {
    **{f"K = 2, steps × {s}": lambda s=s: changed(steps_times(s)) for s in (1, 4, 16, 64)},
    **{f"K = 2, field rougher × {s}": lambda s=s: changed(rougher(s)) for s in (4, 16, 64)},
    **{f"K = 2, all weights × {s}": lambda s=s: changed(all_times(s)) for s in (2, 64)},
    **{f"K = {k}": lambda k=k: changed(**layers(k)) for k in (1, 4, 16, 64)},
    "K = 64, small steps": lambda: changed(steps_times(0.02), **layers(64)),
    "K = 64, steps × 64": lambda: changed(steps_times(64), **layers(64)),
    "K = 64, all weights × 64": lambda: changed(all_times(64), **layers(64)),
    "K = 2, frequencies to 2^12": lambda: changed(layers=(replace(MLP, xyz_frequencies=13, time_frequencies=13),) * 2),
    "K = 2, frequencies to 2^12, steps × 16": lambda: changed(
        steps_times(16), layers=(replace(MLP, xyz_frequencies=13),) * 2
    ),
    "K = 4, all weights w = 0": lambda: changed(saturated(-200), **layers(4)),
    "K = 2, all weights w = 1": lambda: changed(saturated(200)),
    "K = 2, no weights": lambda: changed(weights=False),
    "K = 2, planes": lambda: changed(**layers(2, "plane")),
    "K = 8, planes": lambda: changed(**layers(8, "plane")),
    "K = 8, planes, steps × 64": lambda: changed(steps_times(64), **layers(8, "plane")),
    **{f"K = 2 on nodes, steps × {s}": lambda s=s: changed(steps_times(s), support=NODES) for s in (1, 16, 64)},
    "K = 8, planes on nodes": lambda: changed(support=NODES, **layers(8, "plane")),
    "K = 64 on nodes": lambda: changed(support=NODES, **layers(64)),
    "K = 2 on one node": lambda: changed(support=replace(NODES, num_nodes=1)),
    "K = 2 on nodes at one place": lambda: changed(nodes_at_one_place, support=NODES),
    "K = 2 on nodes, skinning weights of 0 and 1": lambda: changed(follow_one_node, support=NODES),
    "K = 2 on nodes, a Gaussian far from them": lambda: changed(far_from_nodes, support=NODES),
    "K = 2 on nodes, stretches below their bound": lambda: changed(flattened, support=NODES),
}


def rows_of(case: str) -> list[Row]:
    """Predictions bound measured errors, and accepted models are exact in frames that weren't assessed."""
    model = CASES[case]()
    report = assess(model, SCENE, times=TIMES if len(model.deformation) < 16 else 2)
    name = f"{case}: amplified × {report.worst_amplification:.2g}"
    rows = _predicted(name, report)
    if report.refusal("network") is None:
        seen, psnr = worst_frame(model, lambda t: posed(model, t), UNSEEN_TIMES, cameras=1)
        quantity = f"float32 frames at other times, {seen} of {len(model.gaussians)} Gaussians in them"
        return [*rows, measured(name, quantity, psnr, "stability.accepted_db")]
    row = refused(name, lambda: report.require("network"), "float", quantity="float32 plan")
    if not report.broken and report.refusal("compact:50") is not None:
        row = row._replace(verdict="fails: the remedy is refused, too")
    return [*rows, row]


def _predicted(name: str, report: StabilityReport) -> list[Row]:
    """The predicted round-off is an upper bound as long as it is small enough for the chain to be linear."""
    s = report.samples
    small = s.predicted < tolerance("stability.first_order")
    ratios = s.distance[small] / np.maximum(s.predicted[small], 1e-300)
    quantity = f"float32 means, relative to the predicted error, for {small.mean():.0%} of them"
    return [measured(name, quantity, float(ratios.max()), "stability.predicted")] if small.any() else []


def jacobian_rows() -> Iterator[Row]:
    """The products of Jacobians against central differences through the whole chain."""
    for layer in (replace(MLP, xyz_frequencies=4), PLANE):
        model = changed(layers=(layer,) * 3).double()
        means = model.gaussians.means.detach()
        single = copy.deepcopy(model.deformation).float()
        found = through_layers(model.deformation, single, means, 0.3)
        step, columns, t = 1e-7, [], torch.tensor(0.3, dtype=torch.double)
        with torch.no_grad():
            for axis in torch.eye(3, dtype=torch.double) * step:
                ends = [(means + s * axis) + model.deformation(means + s * axis, t).means for s in (1, -1)]
                columns.append((ends[0] - ends[1]) / (2 * step))
        norms = torch.linalg.matrix_norm(torch.stack(columns, dim=2), ord=2).numpy()
        relative = np.abs(found.after[-1].numpy() - norms) / norms
        smooth = np.median(relative)  # a few steps cross kinks of ReLU or of grids
        yield measured(
            f"K = 3, {layer.kind}", "‖J₃J₂J₁‖ against differences, median", float(smooth), "stability.jacobian"
        )


def all_rows() -> Iterator[Row]:
    yield from jacobian_rows()
    for case in CASES:
        yield from rows_of(case)
