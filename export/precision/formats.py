"""Emulation of a model's deformation in other number formats: float32 or float64 arithmetic with the roundings of the
hardware."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.chain import Deltas, MultiStepDeformation


@dataclass(frozen=True)
class Format:
    """A number format, and the numbers that are rounded to it."""

    name: str
    base: torch.dtype  # means, encodings, sums
    rounded: torch.dtype
    where: Literal["nowhere", "products", "everywhere"]
    """`products`: operands and results of the layers' matrix products; `everywhere`: also before the encoding."""
    meaning: str


FLOAT32 = Format("float32", torch.float32, torch.float32, "nowhere", "as the plan `network` computes")
FORMATS = (
    FLOAT32,
    Format("float64 encoding", torch.float64, torch.float32, "products", "means and encoding in float64, products not"),
    Format("bfloat16", torch.float32, torch.bfloat16, "products", "matrix products in bfloat16, the encoding is not"),
    Format("float16", torch.float32, torch.float16, "products", "matrix products in float16, the encoding is not"),
    Format("float16 throughout", torch.float32, torch.float16, "everywhere", "the means before the encoding as well"),
)


def in_format(model: DynamicGaussians, number_format: Format) -> DynamicGaussians:
    """A copy of the model whose layers compute in `number_format`, and everything after them in its base type."""
    changed = copy.deepcopy(model).to(number_format.base)
    if number_format.where == "nowhere":
        return changed
    rounded = _rounder(number_format.rounded)
    with torch.no_grad():
        for parameter in changed.deformation.parameters():
            parameter.copy_(rounded(parameter))
    changed.deformation = _Emulated(changed.deformation, number_format)
    return changed


def _rounder(dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    return lambda tensor: tensor.to(dtype).to(tensor.dtype)


class _Emulated(MultiStepDeformation):
    """The same layers with roundings between their operations."""

    def __init__(self, exact: MultiStepDeformation, number_format: Format) -> None:
        nn.Module.__init__(self)
        self.layers = exact.layers
        self.number_format = number_format

    def forward(self, means: Tensor, t: Tensor, num_layers: int | None = None) -> Deltas:
        with torch.no_grad(), _Rounding(self.number_format):
            return super().forward(means, t, num_layers)


_PRODUCTS = ("aten::addmm", "aten::addmv", "aten::linear")
"""Products that are rounded. `aten::mm` computes phases of the encoding, which are exact in every format that holds the
means, and blends motions, which is cheap in float32."""


class _Rounding(TorchDispatchMode):
    """Rounds operands and results of operations. Parameters are rounded already, so views of them don't change."""

    def __init__(self, number_format: Format) -> None:
        super().__init__()
        self._everywhere = number_format.where == "everywhere"
        self._rounded = _rounder(number_format.rounded)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not (self._everywhere or func.name().split(".")[0] in _PRODUCTS):
            return func(*args, **(kwargs or {}))
        results = func(*[self._operand(a) for a in args], **(kwargs or {}))
        for result in results if isinstance(results, tuple | list) else (results,):
            if isinstance(result, Tensor) and result.is_floating_point():
                result.copy_(self._rounded(result))
        return results

    def _operand(self, value: Any) -> Any:
        if self._everywhere or not (isinstance(value, Tensor) and value.is_floating_point()):
            return value  # already rounded as a result
        return self._rounded(value)
