"""Plan `keyframes:n`: n stored poses a Gaussian, the control points of a cubic spline over time.

Positions, scales and quaternions of one sign are splines, the quaternions made unit after blending: the shortest way.
A call reads the four poses next to its time. With a number of poses, Gaussians that these get most wrong keep more;
with an error, each keeps as few as it needs.
"""

import numpy as np
import onnx

from export.jobs.bake import Baked
from export.plans.scene_graph import activated, finished, new_graph
from export.plans.size import Size
from export.trajectories.adaptive import fitted, own_poses, worst
from export.trajectories.sampling import Ids, Trajectories
from export.trajectories.stored import GriddedPoses, StoredPoses, of_ids


def keyframes(baked: Baked, trajectories: Trajectories, size: Size) -> onnx.ModelProto:
    """The scene with `size.count` poses for all, or with as few of each Gaussian as are within `size.pixels`."""
    every = np.arange(trajectories.count)
    if size.count is None:
        poses, errors = own_poses(trajectories, every, size.pixels or 0)
    else:
        poses, errors = _mostly_of_one_size(trajectories, every, size.count)
    graph, time_range = new_graph(baked), baked.scene.metadata.time_range
    activated(graph, of_ids(graph, poses, time_range))
    own = len(every) - max(len(rows) for rows, _ in poses.grids)
    return finished(graph, baked, str(size), trajectories.promise(errors, own))


def _mostly_of_one_size(trajectories: Trajectories, every: Ids, count: int) -> tuple[GriddedPoses, np.ndarray]:
    """So many poses for all but the worst, which keep as few as are no worse than any other; and all errors, [N]."""
    control, errors = fitted(trajectories, every, count)
    chosen = worst(trajectories, errors, None)
    rest = np.delete(every, chosen)
    own, own_errors = own_poses(trajectories, chosen, errors[rest].max(initial=0) / trajectories.pixel)
    errors[chosen] = own_errors
    grids = [(chosen[rows], stored) for rows, stored in own.grids]
    return GriddedPoses(((rest, StoredPoses.of(control[rest])), *grids)), errors
