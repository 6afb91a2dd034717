"""Plan `keyframes:n`: n stored poses per Gaussian, the control points of a cubic spline over time.

Means, scales and quaternions of one sign are splines; quaternions are normalized after blending. A call reads the four
poses next to its time. With a number of poses, the Gaussians with the largest errors store more; with an error bound,
each stores as few as it needs.
"""

import numpy as np
import onnx

from export.jobs.bake import Baked
from export.plans.base import Plan, PlanSpec
from export.plans.scene_graph import activated, finished, new_graph
from export.trajectories.adaptive import COUNTS, adaptive_knots, fitted, worst
from export.trajectories.sampling import Ids, Trajectories
from export.trajectories.splines import MIN_CONTROL_POINTS
from export.trajectories.stored import GriddedPoses, StoredPoses, of_ids


def keyframes(baked: Baked, spec: PlanSpec, trajectories: Trajectories) -> onnx.ModelProto:
    """The scene with `spec.count` poses per Gaussian, or with as few per Gaussian as `spec.max_pixels` allows."""
    every = np.arange(trajectories.count)
    if spec.count is None:
        poses, errors = adaptive_knots(trajectories, every, spec.max_pixels or 0)
    else:
        poses, errors = _mostly_of_one_size(trajectories, every, spec.count)
    graph, time_range = new_graph(baked), baked.scene.metadata.time_range
    activated(graph, of_ids(graph, poses, time_range))
    own = len(every) - max(len(rows) for rows, _ in poses.grids)
    return finished(graph, baked, str(spec), trajectories.error_bound(errors, own))


def _mostly_of_one_size(trajectories: Trajectories, every: Ids, count: int) -> tuple[GriddedPoses, np.ndarray]:
    """`count` poses for all but the Gaussians with the largest errors, which get as many as the largest error of the
    others requires; and all errors, [N]."""
    control, errors = fitted(trajectories, every, count)
    chosen = worst(trajectories, errors, None)
    rest = np.delete(every, chosen)
    own, own_errors = adaptive_knots(trajectories, chosen, errors[rest].max(initial=0) / trajectories.pixel)
    errors[chosen] = own_errors
    grids = [(chosen[rows], stored) for rows, stored in own.grids]
    return GriddedPoses(((rest, StoredPoses.of(control[rest])), *grids)), errors


KEYFRAMES = Plan(
    "keyframes",
    f"keyframes:n, n poses, {MIN_CONTROL_POINTS} to {COUNTS[-1]}",
    "#a463f2",
    lambda baked, spec, sample: keyframes(baked, spec, sample()),
    candidates=lambda layers: ["keyframes:2.0", "keyframes:0.5", "keyframes:0.1", "keyframes:0.03"],
    counts=range(MIN_CONTROL_POINTS, COUNTS[-1] + 1),
    fitted=True,
)
