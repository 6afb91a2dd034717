"""Plan `keyframes:n`: n stored poses a Gaussian, the control points of a cubic spline over time.

Positions, scales and quaternions of one sign are splines, the quaternions made unit after blending: the shortest way.
A call reads the four poses next to its time. Gaussians that n poses get most wrong keep more of their own.
"""

import numpy as np
import onnx

from export.bake import Baked
from export.plans.own_poses import SHARED_COUNTS, fitted, own_poses, worst
from export.plans.scene_graph import activated, finished, new_graph
from export.plans.size import Size
from export.plans.splines import FEWEST
from export.plans.stored_poses import StoredPoses, shared_grid, with_own_poses
from export.plans.trajectories import Trajectories

OWN_BYTES = 5_000
"""Of a Gaussian with poses of its own, roughly; for choosing n."""

SAMPLED = 4_096
"""Gaussians at which n is chosen."""


def keyframes(baked: Baked, trajectories: Trajectories, size: Size) -> onnx.ModelProto:
    """The scene with `size.count` poses for all, or with as many as take the fewest bytes for `size.pixels`."""
    count = size.count or _fewest_bytes(trajectories, size.pixels or 0)
    every = np.arange(trajectories.count)
    control, errors = fitted(trajectories, every, count)
    chosen = worst(trajectories, errors, size.pixels)
    most = size.pixels or np.delete(errors, chosen).max(initial=0) / trajectories.pixel
    own, own_errors = own_poses(trajectories, chosen, most)
    errors[chosen] = own_errors
    graph, time_range = new_graph(baked), baked.scene.metadata.time_range
    pose = shared_grid(graph, StoredPoses.of(control), time_range)
    activated(graph, with_own_poses(graph, pose, own, trajectories.count, time_range))
    return finished(graph, baked, str(size), trajectories.promise(errors, len(own)))


def _fewest_bytes(trajectories: Trajectories, pixels: float) -> int:
    stride = -(-trajectories.count // SAMPLED)
    ids = np.arange(0, trajectories.count, stride)

    def bytes_each(count: int) -> float:
        _, errors = fitted(trajectories, ids, count)
        return 20 * count + OWN_BYTES * float((errors > pixels * trajectories.pixel).mean())

    return min((FEWEST, *SHARED_COUNTS), key=bytes_each)
