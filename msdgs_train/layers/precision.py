"""The precision of the matrix products of MLP trunks on a GPU. Encodings, heads and all else stay in float32."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Literal

import torch

Precision = Literal["float32", "tf32", "bf16"]

_chosen: ContextVar[Precision] = ContextVar("_chosen", default="float32")


@contextmanager
def trunk_precision(precision: Precision) -> Iterator[None]:
    """Choose the precision of the trunks that run inside, and of their gradients; for the calling thread."""
    token = _chosen.set(precision)
    try:
        yield
    finally:
        _chosen.reset(token)


def chosen_precision() -> Precision:
    """float32 unless `trunk_precision` has chosen another."""
    return _chosen.get()


def matrix_products(precision: Precision) -> AbstractContextManager[None]:
    """Allow TF32 in matrix products on CUDA if that is the precision. The flag is the process's: one thread at a time
    may compute on the GPU."""
    return _tf32() if precision == "tf32" else nullcontext()


@contextmanager
def _tf32() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
