"""Where tensors are computed with: by kernels on the CPU, by torch's operations on other devices."""

import numpy as np
import torch
from torch import Tensor


def has_kernels(tensor: Tensor) -> bool:
    """Whether kernels compute with this tensor, which is then on the CPU; otherwise torch's operations do."""
    return tensor.device.type == "cpu"


def to_array(tensor: Tensor) -> np.ndarray:
    """A contiguous array on the CPU; gradients don't flow through."""
    return tensor.detach().cpu().contiguous().numpy()


def to_device(tensor: Tensor, device: str | torch.device) -> Tensor:
    """Copy a tensor of the CPU without waiting for what the device computes."""
    return tensor if torch.device(device).type == "cpu" else tensor.pin_memory().to(device, non_blocking=True)
