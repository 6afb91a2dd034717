"""The lines of `metrics.jsonl` as TensorBoard reads them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from msdgs_train.engine.extras import ExtraMissing

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

FOLDER = "tensorboard"
TRAIN_SCALARS = ("loss", "psnr", "gaussians", "skipped", "seconds")
EVAL_SCALARS = ("psnr", "ssim")


def require_tensorboard() -> None:
    """Raise `ExtraMissing` if tensorboard isn't installed."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError:
        raise ExtraMissing("--tensorboard", "tensorboard", "tensorboard") from None


def open_events(folder: Path, lines: list[dict[str, Any]], purge_step: int) -> "SummaryWriter":
    """Open a writer of event files in a folder. TensorBoard drops the steps from `purge_step` on of earlier files.

    `lines`, those that `metrics.jsonl` has kept, are written again from this step on; a new folder gets all of them,
    as a resumed run may turn TensorBoard on.
    """
    from torch.utils.tensorboard import SummaryWriter

    first = purge_step if folder.exists() else 0
    writer = SummaryWriter(str(folder), purge_step=purge_step)
    for line in lines:
        if line["step"] >= first:
            add_scalars(writer, line)
    return writer


def add_scalars(writer: "SummaryWriter", line: dict[str, Any]) -> None:
    """Add a line of `metrics.jsonl`: `train/loss`, `train/psnr`, …, or `test/psnr`, `test/ssim`."""
    group, names = ("train", TRAIN_SCALARS) if line["kind"] == "train" else (line["split"], EVAL_SCALARS)
    for name in names:
        if name in line:  # lines of older runs have fewer
            writer.add_scalar(f"{group}/{name}", line[name], line["step"])
