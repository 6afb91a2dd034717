"""Tensors as NumPy arrays for kernels."""

import numpy as np
from torch import Tensor


def to_array(tensor: Tensor) -> np.ndarray:
    """A contiguous array on the CPU; gradients don't flow through."""
    return tensor.detach().cpu().contiguous().numpy()
