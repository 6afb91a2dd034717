"""The moving scene of Gaussians with `Splats.motion`: polynomials of time, as SpacetimeGaussians has them. Plan
`polynomial`."""

from dataclasses import replace

import numpy as np
import onnx

from msdgs_export.bake import Baked, Moving
from msdgs_export.importers.scene import metadata_of
from msdgs_export.importers.splats.base import Splats, as_float32
from msdgs_export.importers.splats.spacetime import Spacetime
from msdgs_export.plans.scene_graph import activated, changing_output, finished, new_graph
from msdgs_export.trajectories.poses import POSE
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_serve.scene.similarity import IDENTITY, Similarity

PLAN = "polynomial"
CHANGING = ("opacities",)


def polynomial_scene(source: Splats, sha256: str) -> onnx.ModelProto:
    """The scene file, in which all Gaussians move and all opacities change."""
    g, motion = source.gaussians, _motion(source)
    place = IDENTITY if source.offset is None else Similarity(1.0, tuple(source.offset.tolist()))
    metadata = metadata_of(g.means, g.sh_degree, sha256, source.antialiasing, source.dropped, source.up, place)
    three = np.empty((0, 3), np.float32)
    appearance = (np.empty(0, np.float32), g.sh)
    static = (three, np.empty((0, 4), np.float32), three)
    scene = BakedScene(replace(metadata, plan=PLAN), len(g), *static, *appearance, changing=CHANGING)
    scene.validate("the imported scene")
    baked = Baked(scene, Moving(g.means, g.scales, g.quats, g.quats), ())
    graph = new_graph(baked)
    since = graph.node("Sub", ["t", graph.constant("motion.center", motion.center)], "motion.since")  # [N, 1]

    def times_since(value: str, output: str) -> str:
        return graph.node("Mul", [value, since], output)

    def plus(value: str, name: str, array: np.ndarray) -> str:
        return graph.node("Add", [value, graph.constant(name, array)], f"{name}.sum")

    value = times_since(graph.constant("motion.cubic", motion.motion[:, 6:]), "motion.cubic.product")
    value = times_since(plus(value, "motion.quadratic", motion.motion[:, 3:6]), "motion.quadratic.product")
    value = times_since(plus(value, "motion.linear", motion.motion[:, :3]), "motion.linear.product")
    means = plus(value, "mean.means", g.means)
    turned = times_since(graph.constant("motion.omega", motion.omega), "motion.turned")
    quats = plus(turned, "mean.quats", g.quats)
    width = graph.node("Exp", [graph.constant("motion.log_width", motion.log_width)], "motion.width")
    distance = graph.node("Div", [since, width], "motion.distance")
    squared = graph.node("Mul", [distance, distance], "motion.squared")
    minus = graph.constant("motion.minus", np.array(-1, np.float32))
    faded = graph.node("Exp", [graph.node("Mul", [squared, minus], "motion.exponent")], "motion.faded")
    shown = graph.node("Mul", [faded, graph.constant("mean.opacities", g.opacities[:, None])], "motion.opacities")
    poses = graph.node("Concat", [means, graph.constant("mean.scales", g.scales), quats, shown], "poses.raw", axis=1)
    rows = graph.node("Gather", [poses, "ids"], "poses.of_ids")
    pose, opacities = graph.split(rows, ["ids.pose", "ids.opacities"], [POSE, 1])
    activated(graph, pose)
    changing_output(graph, scene, "opacities", opacities)
    return finished(graph, baked, PLAN)


def at_time(source: Splats, t: float) -> Gaussians:
    """The Gaussians at one time, computed in float64."""
    g, motion = source.gaussians, _motion(source)
    since = t - motion.center.astype(np.float64)
    linear, quadratic, cubic = np.split(motion.motion.astype(np.float64), 3, axis=1)
    distance = since / np.exp(motion.log_width.astype(np.float64))
    return Gaussians(
        as_float32(g.means + since * (linear + since * (quadratic + since * cubic))),
        as_float32(_unit(g.quats + since * motion.omega)),
        g.scales,
        as_float32(g.opacities * np.exp(-np.square(distance[:, 0]))),
        g.sh,
    )


def _motion(source: Splats) -> Spacetime:
    assert source.motion is not None
    return Spacetime.of(source.motion)


def _unit(quats: np.ndarray) -> np.ndarray:
    """As the graph normalizes them: the identity if there is no direction."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(norms < MIN_NORM, (1, 0, 0, 0), quats / np.maximum(norms, MIN_NORM))
