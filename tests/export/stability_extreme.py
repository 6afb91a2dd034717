"""Extreme models and scenes: known traps of number formats, a million Gaussians, sizes, scales, opacities, NaN."""

import copy
import itertools
import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch

from msdgs_export.bake import bake
from msdgs_export.measure.poses import half_diagonal, in_float64, largest_error, pose_errors, posed
from msdgs_export.plans.registry import build
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import Gaussians
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, load_model, save_model
from msdgs_train.layers.base import SceneBounds
from msdgs_train.layers.mlp import MLPConfig, frequency_matrix, positional_encoding
from msdgs_train.layers.plane import PlaneConfig
from tests.export.stability_rows import Row, measured, refused, relative, worst_frame
from tests.export.stability_rows import changed as any_changed
from tests.support.models import CAMERA, MLP, SCENE, export_scene

COUNT = 60
changed = partial(any_changed, count=COUNT, layers=(replace(MLP, xyz_frequencies=6),))
UNSEEN = (0.0, 0.137, 0.419, 0.733, 0.951, 1.0)
"""Fractions of the time range; the assessment uses other times."""

MOVES, SCALES = "pose from the scene file", "scales from the file, relative"


def exported(model: DynamicGaussians, scene: SceneInfo = SCENE) -> DeformationSession:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        save_model(path / "model.pt", model, scene, 1)
        return DeformationSession(export_scene(path / "model.pt", path / "scene.onnx", times=3).path)


def file_error(model: DynamicGaussians, scene: SceneInfo = SCENE, session: DeformationSession | None = None) -> float:
    """Return the largest error of the file's poses against the model in float64, at both ends and between, as
    `msdgs_export.jobs.verify` measures it."""
    session = session or exported(model, scene)
    exact, worst = in_float64(model), 0.0
    for t in (scene.time_range[0], sum(scene.time_range) / 2, scene.time_range[1]):
        drawn = session.gaussians(t).validate()
        errors = pose_errors(drawn, exact(t), half_diagonal(scene.bounds))
        worst = max(worst, float(largest_error(errors).max(initial=0)))
    return worst


def traps() -> Iterator[Row]:
    """Known traps of number formats."""
    yield from _encoding()
    yield measured("fp16 covariance: scales of 1e-4", SCALES, _scale_error(1e-4), "float32.relative")
    far = changed(lambda m: m.gaussians.means.add_(30.0), layers=())
    session = exported(far, replace(SCENE, bounds=[[28.7] * 3, [31.3] * 3], cameras=[]))
    yield measured(
        "fp16 positions: 30 units away",
        "means from the file, relative",
        relative(session.scene.static_means, far.gaussians.means.detach().numpy()),
        "float32.relative",
    )
    for norm in (0.0, 1e-12):
        model = changed(lambda m, n=norm: m.gaussians.raw_quats.copy_(torch.tensor([0.0, n, 0.0, 0.0])), layers=())
        identity = np.tile([1.0, 0, 0, 0], (COUNT, 1))
        yield measured(
            f"quaternions of length {norm:g}",
            "identity in the file",
            float(np.abs(exported(model).scene.static_quats - identity).max()),
            "float32.relative",
        )
    heads = "deformation.layers.0.heads.bias"
    shrinking = changed(lambda m: m.get_parameter(heads)[3:6].fill_(-10.0), scale_space="linear")
    yield measured("activated ΔS of −5 on scales of 0.1", MOVES, file_error(shrinking), "export.relative")
    for logit in (1e4, -1e4):
        model = changed(lambda m, v=logit: m.get_parameter("modulation.output.bias").fill_(v))
        yield measured(f"exp of the modulation: exponent {logit:g}", MOVES, file_error(model), "export.relative")


def _encoding() -> Iterator[Row]:
    x = torch.linspace(-1.3, 1.3, 20_001, dtype=torch.double)[:, None].float()
    exact = positional_encoding(x.double(), frequency_matrix(1, 10).double())
    single = positional_encoding(x, frequency_matrix(1, 10))
    half = positional_encoding(x.half().float(), frequency_matrix(1, 10))
    yield measured("encoding at 2⁹", "sines in float32", float((single - exact).abs().max()), "encoding.float32")
    types = {t.data_type for t in onnx.load_from_string(_network(changed())).graph.initializer}
    half_types = len(types & {onnx.TensorProto.FLOAT16, onnx.TensorProto.BFLOAT16})
    name = f"encoding at 2⁹ in float16, off by {float((half - exact).abs().max()):.2f}"
    yield measured(name, "such numbers in a scene file", half_types, "stability.none")


def _network(model: DynamicGaussians) -> bytes:
    return build("network", bake(model, SCENE, "0" * 64)).SerializeToString()


def _scale_error(scale: float) -> float:
    model = changed(lambda m: m.gaussians.log_scales.fill_(math.log(scale)), layers=())
    return relative(exported(model).scene.static_scales, in_float64(model)(0.0).scales)


def a_million() -> Iterator[Row]:
    """A million moving Gaussians, a few of which are compared."""
    small = MLPConfig(width=4, depth=1, xyz_frequencies=1, time_width=4, time_features=2)
    model = changed(_many, count=2, layers=(small,), embedding_dim=0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.onnx"
        path.write_bytes(_network(model))
        means, quats, scales = DeformationSession(path).pose(0.5)
    ids = np.arange(0, len(means), 997)
    got = Gaussians(means[ids], quats[ids], scales[ids], np.ones(len(ids)), np.zeros((len(ids), 1, 3)))
    errors = pose_errors(got, posed(copy.deepcopy(model).double(), 0.5, ids), half_diagonal(SCENE.bounds))
    yield measured(f"N = {len(means):,}", MOVES, float(largest_error(errors).max()), "export.relative")


def _many(model: DynamicGaussians) -> None:
    for name, parameter in list(model.gaussians.named_parameters()):
        many = parameter.detach().repeat(500_000, *[1] * (parameter.ndim - 1))
        model.gaussians.register_parameter(name, torch.nn.Parameter(many))


def extents() -> Iterator[Row]:
    """The same scene in other units. Plane layers know their extent; MLP layers encode scene units as they are."""
    for kind in ("plane", "mlp"):
        for exponent in (-6, -3, 0, 3, 6):
            model, scene = _scaled(kind, 10.0**exponent)
            case = f"extent × 1e{exponent}, two {kind} layers"
            try:
                session = exported(model, scene)
            except MsdgsError:
                reason = "near plane" if exponent < 0 else "float32"
                yield refused(case, lambda m=model, s=scene: exported(m, s), reason)
                continue
            unstable = session.scene.metadata.measured_error["unstable"]["count"]
            if unstable:  # no float32 file can hold these poses, so frames are compared
                times = np.interp(UNSEEN, (0, 1), scene.time_range).tolist()
                seen, psnr = worst_frame(model, session.gaussians, times, scene)
                quantity = f"frames of the scene file, {unstable} of {COUNT} Gaussians unstable, {seen} in them"
                yield measured(case, quantity, psnr, "stability.accepted_db")
            else:
                yield measured(case, MOVES, file_error(model, scene, session), "export.relative")


def _scaled(kind: str, factor: float) -> tuple[DynamicGaussians, SceneInfo]:
    like = changed(layers=(kind, kind))
    model = DynamicGaussians(like.config, like.gaussians, SceneBounds(1.3 * factor))
    own = ("cells", "first_time", "time_cells")
    model.load_state_dict({n: v for n, v in like.state_dict().items() if n.split(".")[-1] not in own}, strict=False)
    with torch.no_grad():
        model.gaussians.means.mul_(factor)
        model.gaussians.log_scales.add_(math.log(factor))
        for k, part in itertools.product((0, 1), ("weight", "bias")):
            head = f"deformation.layers.{k}.heads" + (".0" if kind == "plane" else "")
            model.get_parameter(f"{head}.{part}")[:3] *= factor
    pose = np.array(CAMERA["camera_to_world"])
    pose[:3, 3] *= factor
    cameras = [{"name": "front", "t": 0.0, **CAMERA, "camera_to_world": pose.tolist()}]
    return model, replace(SCENE, bounds=(np.array(SCENE.bounds) * factor).tolist(), cameras=cameras)


def shapes() -> Iterator[Row]:
    """Extreme scales and opacities."""
    for exponent in (-20, -10, 10, 20):
        error = _scale_error(math.exp(exponent))
        yield measured(f"scales of e^{exponent}", SCALES, error, "float32.relative")
    for logit, opacity in ((200.0, 1.0), (-200.0, 0.0)):
        model = changed(lambda m, v=logit: m.gaussians.raw_opacities.fill_(v))
        error = float(np.abs(exported(model).scene.opacities - opacity).max())
        yield measured(f"opacity {opacity:g}: logit {logit:g}", "opacities from the file", error, "float32.relative")


def poison() -> Iterator[Row]:
    """NaN and inf in each tensor of a model file, and in its scene."""
    contents = _contents()
    for value in (math.nan, math.inf):
        missed, named = [], ""
        tensors = {name: tensor for name, tensor in contents["state"].items() if tensor.numel()}
        for name, tensor in tensors.items():
            bad = tensor.clone()
            bad.view(-1)[:2] = value
            count = min(2, tensor.numel())
            state = {**contents["state"], name: bad}
            broken, reason = {**contents, "state": state}, f"{name} ({count} of {tensor.numel():,})"
            row = refused("", lambda c=broken: _loaded(c), reason)
            missed += [] if row.verdict.startswith("refused") else [f"{name}: {row.verdict}"]
            named = row.verdict
        case = f"{value} in each of the {len(tensors)} tensors of a model"
        yield Row(case, "", "–", "a refusal", f"fails: {missed[0]}" if missed else named)
    huge = {**contents["state"], "gaussians.means": torch.full((3, 3), 1e300, dtype=torch.double)}
    broken = {**contents, "state": huge}
    yield refused("1e300 in a float64 tensor", lambda: _loaded(broken), "gaussians.means (9 of 9)")
    for name, value in (
        ("time_range", (0.0, math.nan)),
        ("time_range", (1.0, 0.0)),
        ("background", (0.0, math.inf, 0.0)),
        ("bounds", [[-math.inf] * 3, [1.0] * 3]),
        ("cameras", [{**SCENE.cameras[0], "fx": math.nan}]),
    ):
        scene = replace(SCENE, **{name: value})
        case = f"scene `{name}` = {value}" if name != "cameras" else "a camera of the scene with fx = nan"
        yield refused(case, lambda s=scene: exported(changed(), s), name.removesuffix("s"))


def _contents() -> dict[str, Any]:
    model = changed(count=3, layers=(replace(MLP, width=4), PlaneConfig(resolution=2, time_resolution=2, width=4)))
    with tempfile.TemporaryDirectory() as folder:
        save_model(Path(folder) / "model.pt", model, SCENE, 1)
        return torch.load(Path(folder) / "model.pt", weights_only=True)


def _loaded(contents: dict[str, Any]) -> object:
    with tempfile.TemporaryDirectory() as folder:
        torch.save(contents, Path(folder) / "model.pt")
        return load_model(Path(folder) / "model.pt")


GROUPS = (traps, a_million, extents, shapes, poison)
