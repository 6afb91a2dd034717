"""The lines of `metrics.jsonl`, and renderings beside their images, as TensorBoard reads them."""

from pathlib import Path
from typing import Any

import numpy as np

from msdgs_train.engine.extras import ExtraMissing

FOLDER = "tensorboard"
TRAIN_SCALARS = ("loss", "psnr", "gaussians", "skipped", "clamped_scales", "seconds")
EVAL_SCALARS = ("psnr", "ssim")


def require_tensorboard() -> None:
    """Raise `ExtraMissing` where events can't be written."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError:
        raise ExtraMissing("--tensorboard", "tensorboard", "tensorboard") from None


class TensorBoardEvents:
    """Event files in a folder; a resumed run adds one."""

    def __init__(self, folder: Path, lines: list[dict[str, Any]], keep_until: int) -> None:
        """TensorBoard drops what earlier files hold of steps after `keep_until`.

        A folder that is new gets `lines`, those of `metrics.jsonl` up to that step, so that it may also be asked for
        when a run is resumed.
        """
        from torch.utils.tensorboard import SummaryWriter

        is_new = not folder.exists()
        self._writer = SummaryWriter(str(folder), purge_step=keep_until + 1)
        if is_new:
            for line in lines:
                self.add(line)

    def add(self, line: dict[str, Any]) -> None:
        """One line: `train/loss`, `train/psnr`, …, or `test/psnr`, `test/ssim`."""
        group, names = ("train", TRAIN_SCALARS) if line["kind"] == "train" else (line["split"], EVAL_SCALARS)
        for name in names:
            if name in line:  # lines of older runs have fewer
                self._writer.add_scalar(f"{group}/{name}", line[name], line["step"])

    def image(self, step: int, name: str, pixels: np.ndarray) -> None:
        """[H, W, 3] uint8."""
        self._writer.add_image(name, pixels, step, dataformats="HWC")

    def flush(self) -> None:
        """What was added is in the file."""
        self._writer.flush()

    def close(self) -> None:
        """Nothing can be added any more."""
        self._writer.close()
