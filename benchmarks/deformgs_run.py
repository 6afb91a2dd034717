"""A run of Deformable-3D-Gaussians at full size, made up: `python benchmarks/deformgs_run.py runs/made`.

100,000 Gaussians, its network of 8 × 256 with a skip, 522,280 parameters, smooth motion of about a tenth of the object,
cameras on a circle. Then `python export/to_onnx.py runs/made -o made.onnx` imports it and chooses a plan.
"""

import argparse
import json
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from torch import Tensor

from benchmarks.splat_scenes import object_camera, object_scene
from export.exporters.ply import write_ply

DEPTH, WIDTH = 8, 256
XYZ, TIME, TIME_WIDTH, TIME_FEATURES = 10, 6, 256, 30
DAMPING = 0.3
"""Weights of each next octave of the encodings, of those before: motion is smooth in place and time."""

MOTION = {"gaussian_warp": (3, 0.1), "gaussian_scaling": (3, 5e-4), "gaussian_rotation": (4, 0.05)}
"""Heads: columns, and about how large what they say is: scene units, scene units, parts of a unit quaternion."""

ITERATION = 40_000
CAMERAS = 12


def main() -> None:
    """Write the folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians")
    parser.add_argument("--size", type=int, default=800, help="pixels of its cameras' images")
    options = parser.parse_args()
    cloud = options.folder / "point_cloud" / f"iteration_{ITERATION}" / "point_cloud.ply"
    network = options.folder / "deform" / f"iteration_{ITERATION}" / "deform.pth"
    for file in (cloud, network):
        file.parent.mkdir(parents=True, exist_ok=True)
    gaussians = object_scene(options.count)
    write_ply(cloud, gaussians)
    torch.save(state(), network)
    cameras = [camera(i, options.size) for i in range(CAMERAS)]
    (options.folder / "cameras.json").write_text(json.dumps(cameras))
    (options.folder / "cfg_args").write_text("Namespace(sh_degree=3, white_background=False, is_blender=True)")


def state() -> dict[str, Tensor]:
    """Random weights of a scale that keeps what passes through as large as it came."""
    generator = torch.Generator().manual_seed(0)
    tensors: dict[str, Tensor] = {}

    def linear(name: str, columns: Tensor, outputs: int) -> None:
        """He's initialisation, for inputs that count as much as `columns` has it."""
        weight = torch.randn(outputs, len(columns), generator=generator) * columns
        tensors[f"{name}.weight"] = weight * math.sqrt(2 / float(columns.square().sum()))
        tensors[f"{name}.bias"] = 0.1 * torch.randn(outputs, generator=generator)

    linear("timenet.0", octave_weights(1, TIME), TIME_WIDTH)
    linear("timenet.2", torch.ones(TIME_WIDTH), TIME_FEATURES)
    given = torch.cat([octave_weights(3, XYZ), torch.full((TIME_FEATURES,), 0.3)])
    for i in range(DEPTH):
        inputs = given if i == 0 else torch.ones(WIDTH)
        linear(f"linear.{i}", torch.cat([given, inputs]) if i == DEPTH // 2 + 1 else inputs, WIDTH)
    for name, (outputs, size) in MOTION.items():
        linear(name, torch.ones(WIDTH), outputs)
        for kind in ("weight", "bias"):
            tensors[f"{name}.{kind}"] *= size
    return tensors


def octave_weights(dimensions: int, frequencies: int) -> Tensor:
    """Of x, sin x, cos x, sin 2x, cos 2x, …"""
    frequency_matrix = [torch.full((2 * dimensions,), DAMPING**k) for k in range(frequencies)]
    return torch.cat([torch.ones(dimensions), *frequency_matrix])


def camera(number: int, size: int) -> dict[str, object]:
    """As INRIA's trainer writes it."""
    view = object_camera(size, size, turn=2 * math.pi * number / CAMERAS)
    pose = view.camera_to_world
    named = {"id": number, "img_name": f"r_{number}", "width": size, "height": size, "fx": view.fx, "fy": view.fy}
    return {**named, "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}


if __name__ == "__main__":
    main()
