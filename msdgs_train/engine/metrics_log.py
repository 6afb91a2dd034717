"""Metrics of a run as JSON lines and as a plot, and renderings beside their images."""

import json
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from msdgs_serve.writing import replacing, write_text, writing
from msdgs_train.datasets.common.images import write_png
from msdgs_train.engine.run_record import CURVE, METRICS, RENDERS
from msdgs_train.engine.tensorboard_events import FOLDER, add_scalars, open_events
from msdgs_train.engine.trainer import EvaluatedFrame, StepResult
from msdgs_train.evaluation.metrics import ImageMetrics

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class MetricsLog:
    """Lines of `metrics.jsonl`: {"kind": "train", "step", "loss", "psnr", …} and {"kind": "eval", "split", …}.

    With `tensorboard` the same numbers also go to event files in `tensorboard/`, and so do images.
    """

    def __init__(
        self, run: Path, *, keep_until: int = 0, keep_evaluations: bool = True, tensorboard: bool = False
    ) -> None:
        """Keep the lines up to step `keep_until` and drop later ones, and evaluations of this step unless they are to
        be kept."""
        self._run, self._tensorboard = run, tensorboard
        self._events: SummaryWriter | None = None
        self.rewind(keep_until, keep_evaluations=keep_evaluations)

    def rewind(self, step: int, *, keep_evaluations: bool = True) -> None:
        """Drop the lines of steps after `step`, and evaluations of this step unless they are to be kept."""
        kept = [line for line in read_metrics(self._run) if line["step"] <= step]
        if not keep_evaluations:
            kept = [line for line in kept if (line["kind"], line["step"]) != ("eval", step)]
        write_text(self._run / METRICS, "".join(json.dumps(line) + "\n" for line in kept))
        self.close()
        if self._tensorboard:
            with self._writing_events():
                self._events = open_events(self._run / FOLDER, kept, step + 1 if keep_evaluations else step)

    def train(self, result: StepResult, seconds: float) -> None:
        """Add a line of training metrics."""
        self._append({"kind": "train", **result._asdict(), "seconds": round(seconds, 3)})

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        """Add a line of held-out metrics."""
        self._append({"kind": "eval", "step": step, "split": split, **metrics._asdict()})

    def image(self, step: int, split: str, evaluated: EvaluatedFrame) -> None:
        """Add a held-out image and its rendering, side by side; to TensorBoard only."""
        if self._events is not None:
            name = f"{split}/{_stem(evaluated)}"
            with self._writing_events():
                self._events.add_image(name, side_by_side(evaluated), step, dataformats="HWC")

    def flush(self) -> None:
        """Write buffered events to disk."""
        if self._events is not None:
            with self._writing_events():
                self._events.flush()

    def close(self) -> None:
        """Close the event files."""
        if self._events is not None:
            with self._writing_events():
                self._events.close()

    def _writing_events(self) -> AbstractContextManager[None]:
        folder = self._run / FOLDER
        return writing(folder, str(folder))

    def _append(self, line: dict[str, Any]) -> None:
        with writing(self._run / METRICS), (self._run / METRICS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        if self._events is not None:
            with self._writing_events():
                add_scalars(self._events, line)


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Read the lines of a run's `metrics.jsonl`, without those that a killed process has left incomplete; none if there
    is no such file."""
    path = run / METRICS
    lines = []
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else ():
        with suppress(ValueError):
            lines.append(json.loads(text))
    return lines


def best_evaluations(lines: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """By split, the line of the highest PSNR: "best test iteration", as published tables have it, where the split that
    is reported also chose the step."""
    best: dict[str, dict[str, Any]] = {}
    for line in (line for line in lines if line["kind"] == "eval"):
        split, rest = line["split"], {name: v for name, v in line.items() if name not in ("kind", "split")}
        if split not in best or rest["psnr"] > best[split]["psnr"]:
            best[split] = rest
    return best


def draw_curve(run: Path) -> None:
    """Plot loss, PSNR on training and held-out images, and the size of the model against steps, into `curve.png`."""
    lines = read_metrics(run)
    train = [line for line in lines if line["kind"] == "train"]
    figure = Figure(figsize=(9, 9))
    figure.subplots_adjust(0.1, 0.06, 0.97, 0.98, hspace=0.05)
    loss, psnr, count = figure.subplots(3, 1, sharex=True)
    steps = [line["step"] for line in train]
    loss.semilogy(steps, [line["loss"] for line in train])
    psnr.plot(steps, [line["psnr"] for line in train], label="train, moving average")
    for split in sorted({line["split"] for line in lines if line["kind"] == "eval"}):
        points = [(line["step"], line["psnr"]) for line in lines if line["kind"] == "eval" and line["split"] == split]
        psnr.plot(*zip(*points, strict=True), marker="o", label=f"{split}, last {points[-1][1]:.2f} dB")
    psnr.legend()
    count.plot(steps, [line["gaussians"] for line in train])
    for axis, label in ((loss, "loss"), (psnr, "PSNR, dB"), (count, "Gaussians or vertices")):
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    count.set_xlabel("step")
    with replacing(run / CURVE) as temporary:
        figure.savefig(temporary, dpi=110)


def write_side_by_side(run: Path, split: str, evaluated: EvaluatedFrame) -> Path:
    """Write image and rendering, side by side, to `renders/`; returns the PNG's path."""
    folder = run / RENDERS
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{split}_{_stem(evaluated)}.png"
    with replacing(path) as temporary:
        write_png(temporary, side_by_side(evaluated))
    return path


def side_by_side(evaluated: EvaluatedFrame) -> np.ndarray:
    """Image (left) and rendering (right), [H, 2 W, 3] uint8."""
    return to_bytes(np.concatenate([evaluated.target.numpy(), evaluated.rgb.numpy()], axis=1))


def _stem(evaluated: EvaluatedFrame) -> str:
    return Path(evaluated.frame.name).name


def to_bytes(rgb: np.ndarray) -> np.ndarray:
    """Round sRGB values in [0, 1] to uint8."""
    return np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
