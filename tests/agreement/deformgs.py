"""Outputs of Deformable-3D-Gaussians' own program (https://github.com/ingra14m/Deformable-3D-Gaussians), stored in
deformgs.npz.

    python -m tests.agreement.deformgs CHECKOUT

runs the network and five optimizer steps of a checkout on a CPU, with its rates.
"""

import importlib
import sys
from pathlib import Path

import torch
from torch import Tensor

from tests.agreement.fields import LAST_STEP, load_seeded, outputs, trained, write

VECTORS = Path(__file__).with_suffix(".npz")
RATES = (8e-4, 1.6e-6)


def main(checkout: Path) -> None:
    """Write the vectors."""
    sys.path.insert(0, str(checkout))
    theirs = importlib.import_module("utils.time_utils")
    rate = importlib.import_module("utils.general_utils").get_expon_lr_func(*RATES, max_steps=LAST_STEP)
    network = theirs.DeformNetwork(is_blender=True)
    shapes = load_seeded(network)

    def field(means: Tensor, t: float) -> Tensor:
        return torch.cat(network(means, torch.full((len(means), 1), t)), dim=1)

    before = outputs(field)
    optimizer = torch.optim.Adam([{"params": list(network.parameters()), "lr": RATES[0]}], lr=0.0, eps=1e-15)

    def step(i: int) -> None:
        optimizer.param_groups[0]["lr"] = rate(i)

    losses = trained(field, step, optimizer)
    write(
        VECTORS, checkout, "tests.agreement.deformgs", shapes=shapes, before=before, losses=losses, after=outputs(field)
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
