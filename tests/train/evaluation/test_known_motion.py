"""benchmarks/known_motion.py: layers learn where points are, and the error is that of the points."""

import numpy as np

from benchmarks.known_motion import JUDGED_TIMES, MOVING, errors_of
from msdgs_train.comparison.matrix import Budget, read_systems
from msdgs_train.datasets.synthetic.motion import world_positions
from msdgs_train.datasets.synthetic.trajectories import surface_points

POINTS = 20


def test_layers_are_taught_and_judged_by_where_points_are() -> None:
    (untaught,) = read_systems(["msdgs-small"], Budget(1))
    (taught,) = read_systems(["msdgs-small"], Budget(150))
    still = []
    for name in MOVING:
        local = surface_points(name, POINTS, 0)
        middle = world_positions(name, local, 0.5)
        off = [world_positions(name, local, t) - middle for t in np.linspace(0, 1, JUDGED_TIMES)]
        still.append(1e3 * np.sqrt(np.mean(np.sum(np.square(off), axis=2))))
    np.testing.assert_allclose(errors_of(untaught, 0, POINTS), still, rtol=0.05)
    assert (errors_of(taught, 0, POINTS) < 0.8 * np.array(still)).all()
