"""Tiny scene files, written without the exporter."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from msdgs_serve.scene import Camera
from msdgs_serve.scene.baked import CONTRACT, SceneCamera, SceneMetadata, constant_outputs
from msdgs_serve.scene.camera import orbit
from msdgs_serve.scene.metadata import CHANGING_CONTRACT

Color = tuple[float, float, float]
RED: Color = (1.0, 0.0, 0.0)
GREEN: Color = (0.0, 1.0, 0.0)
UP = np.array([0.0, 0.0, 1.0])
SH_DC = 0.28209479177387814


def metadata(**changes: Any) -> SceneMetadata:
    """Metadata of a scene in the cube [-1, 1]³ with two cameras of 64 × 48 pixels, z up; t from 0 to 1."""
    cameras = tuple(
        SceneCamera(f"view_{azimuth}", 0.0, Camera.from_fov(orbit(np.zeros(3), 5.0, azimuth, 20, UP), 64, 48, 40.0))
        for azimuth in (0, 90)
    )
    plain = SceneMetadata(
        contract=CONTRACT,
        layers=("mlp",),
        plan="network",
        time_range=(0.0, 1.0),
        bounds=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
        sh_degree=0,
        delta_space="raw",
        background=(0.2, 0.4, 0.8),
        antialiasing="dilate",
        cameras=cameras,
        left_out=(),
        measured_error={"psnr": 60.0},
        package_version="0.1.0",
        checkpoint_sha256="0" * 64,
    )
    return replace(plain, **changes)


def level_camera(size: int = 64) -> Camera:
    """A square camera 5 units from the origin, at its height, looking at it."""
    return Camera.from_fov(orbit(np.zeros(3), 5.0, 0, 0, UP), size, size, 40.0)


OPACITY = 0.95


def write_scene(
    path: Path,
    *,
    static_color: Color = RED,
    moving: int = 1,
    steps: bool = False,
    changing: Sequence[str] = (),
    **changes: Any,
) -> Path:
    """A ball at the origin, `static_color`, and `moving` green ones that go from (0, 0, -1) to (0, 0, 1); with `steps`
    by a layer that may be applied in part. What is `changing` of their `opacities` and `sh` is 1 - t of what it was,
    contract `msdgs/2`."""
    constants = {
        "base": np.array([[0, 0, -1]] * moving, np.float32).reshape(-1, 3),
        "velocity": np.array([[0, 0, 2]] * moving, np.float32).reshape(-1, 3),
        "moving_quats": np.array([[1, 0, 0, 0]] * moving, np.float32).reshape(-1, 4),
        "moving_scales": np.full((moving, 3), 0.15, np.float32),
        "ids": np.arange(moving, dtype=np.int64),
        "steps" if steps else "one": np.ones(1, np.float32),
        "all_static_means": np.zeros((1, 3), np.float32),
        "all_static_quats": np.array([[1, 0, 0, 0]], np.float32),
        "all_static_scales": np.full((1, 3), 0.15, np.float32),
        "all_opacities": np.full(moving + 1, OPACITY, np.float32),
        "all_sh": np.concatenate([*[constant_color(GREEN)] * moving, constant_color(static_color)]),
    }
    for name in changing:
        constants["whole"] = np.ones(1, np.float32)
        constants[f"moving_{name}"], constants[f"all_static_{name}"] = np.split(constants.pop(f"all_{name}"), [moving])
    nodes = [
        helper.make_node("Gather", ["base", "ids"], ["at_rest"]),
        helper.make_node("Gather", ["velocity", "ids"], ["velocities"]),
        helper.make_node("Mul", ["t", "steps" if steps else "one"], ["applied"]),
        helper.make_node("Mul", ["velocities", "applied"], ["moved"]),
        helper.make_node("Add", ["at_rest", "moved"], ["means"]),
        helper.make_node("Gather", ["moving_quats", "ids"], ["quats"]),
        helper.make_node("Gather", ["moving_scales", "ids"], ["scales"]),
    ]
    nodes += [helper.make_node("Sub", ["whole", "t"], ["left"])] if changing else []
    for name in changing:
        nodes.append(helper.make_node("Gather", [f"moving_{name}", "ids"], [f"first_{name}"]))
        nodes.append(helper.make_node("Mul", [f"first_{name}", "left"], [name]))
    fixed = constant_outputs(changing)
    nodes += [helper.make_node("Identity", [f"all_{name}"], [name]) for name in fixed]
    outputs = {"means": ["M", 3], "quats": ["M", 4], "scales": ["M", 3]}
    outputs |= {name: ["M", *constants[f"moving_{name}"].shape[1:]] for name in changing}
    outputs |= {name: list(constants[f"all_{name}"].shape) for name in fixed}
    graph = helper.make_graph(
        nodes,
        "scene",
        [
            helper.make_tensor_value_info("t", TensorProto.FLOAT, [1]),
            helper.make_tensor_value_info("ids", TensorProto.INT64, ["M"]),
            *([helper.make_tensor_value_info("steps", TensorProto.FLOAT, [1])] if steps else []),
        ],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    contract = {"contract": CHANGING_CONTRACT} if changing else {}
    helper.set_model_props(model, metadata(**(contract | changes)).to_properties())
    onnx.save(model, path)
    return path


def constant_color(color: tuple[float, float, float]) -> np.ndarray:
    """[1, 1, 3]: the same color from every direction."""
    return ((np.array(color) - 0.5) / SH_DC).astype(np.float32).reshape(1, 1, 3)
