"""Outputs of 4DGaussians' own program (https://github.com/hustvl/4DGaussians), stored in fourdgs.npz.

    python -m tests.agreement.fourdgs CHECKOUT

runs the network and five optimizer steps of a checkout on a CPU, with its rates. Its package `scene` is read without
its other modules, which need CUDA.
"""

import argparse
import importlib
import sys
import types
from pathlib import Path

import torch
from torch import Tensor

from tests.agreement.fields import LAST_STEP, load_seeded, outputs, trained, write

VECTORS = Path(__file__).with_suffix(".npz")
RATES, GRID_RATES = (8e-4, 8e-6), (8e-3, 8e-5)
BOX = 1.25  # half its size: some points are outside
SIZES = {
    "net_width": 16, "timebase_pe": 4, "defor_depth": 0, "posebase_pe": 10, "scale_rotation_pe": 2, "opacity_pe": 2,
    "timenet_width": 8, "timenet_output": 4, "grid_pe": 0, "bounds": BOX, "multires": [1, 2], "no_grid": False,
    "empty_voxel": False, "static_mlp": False, "no_dx": False, "no_ds": False, "no_dr": False, "no_do": True,
    "no_dshs": True, "apply_rotation": False,
}  # fmt: skip
PLANES = {
    "grid_dimensions": 2, "input_coordinate_dim": 4, "output_coordinate_dim": 8, "resolution": [10, 10, 10, 9],
}  # fmt: skip


def main(checkout: Path) -> None:
    """Write the vectors."""
    sys.path.insert(0, str(checkout))
    scene = types.ModuleType("scene")
    scene.__path__ = [str(checkout / "scene")]
    sys.modules["scene"] = scene
    theirs = importlib.import_module("scene.deformation")
    rates = importlib.import_module("utils.general_utils").get_expon_lr_func
    network = theirs.deform_network(argparse.Namespace(**SIZES, kplanes_config=PLANES))
    buffers = [name for name, _ in network.named_buffers()]
    shapes = load_seeded(network, [*buffers, "deformation_net.grid.aabb"])

    def field(means: Tensor, t: float) -> Tensor:
        n = len(means)
        times, zeros, opacity = torch.full((n, 1), t), torch.zeros(n, 4), torch.zeros(n, 1)
        found = network(means, zeros[:, :3], zeros, opacity, torch.zeros(n, 16, 3), times)
        return torch.cat([found[0] - means, found[2], found[1]], dim=1)

    before = outputs(field)
    groups = [
        {"params": list(network.get_mlp_parameters()), "lr": RATES[0]},
        {"params": list(network.get_grid_parameters()), "lr": GRID_RATES[0]},
    ]
    optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    decays = [rates(*ends, max_steps=LAST_STEP) for ends in (RATES, GRID_RATES)]

    def step(i: int) -> None:
        for group, decay in zip(optimizer.param_groups, decays, strict=True):
            group["lr"] = decay(i)

    losses = trained(field, step, optimizer)
    write(
        VECTORS, checkout, "tests.agreement.fourdgs", shapes=shapes, before=before, losses=losses, after=outputs(field)
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
