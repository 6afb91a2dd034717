"""The lines of `metrics.jsonl` as TensorBoard reads them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from msdgs_train.engine.extras import ExtraMissing

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

FOLDER = "tensorboard"
TRAIN_SCALARS = ("loss", "psnr", "gaussians", "skipped", "clamped_scales", "seconds")
EVAL_SCALARS = ("psnr", "ssim")


def require_tensorboard() -> None:
    """Raise `ExtraMissing` if tensorboard isn't installed."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError:
        raise ExtraMissing("--tensorboard", "tensorboard", "tensorboard") from None


def open_events(folder: Path, lines: list[dict[str, Any]], keep_until: int) -> "SummaryWriter":
    """Open a writer of event files in a folder. TensorBoard drops the steps after `keep_until` of earlier files.

    A new folder gets `lines`, those of `metrics.jsonl` up to that step: a resumed run may turn TensorBoard on.
    """
    from torch.utils.tensorboard import SummaryWriter

    is_new = not folder.exists()
    writer = SummaryWriter(str(folder), purge_step=keep_until + 1)
    for line in lines if is_new else ():
        add_scalars(writer, line)
    return writer


def add_scalars(writer: "SummaryWriter", line: dict[str, Any]) -> None:
    """Add a line of `metrics.jsonl`: `train/loss`, `train/psnr`, …, or `test/psnr`, `test/ssim`."""
    group, names = ("train", TRAIN_SCALARS) if line["kind"] == "train" else (line["split"], EVAL_SCALARS)
    for name in names:
        if name in line:  # lines of older runs have fewer
            writer.add_scalar(f"{group}/{name}", line[name], line["step"])
