"""The files of an evaluation in RUN/eval: numbers as JSON, a Markdown table and a contact sheet."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import write_text
from msdgs_train.datasets.common.images import resize_area
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.evaluation.evaluate import FILES, EvaluatedModel, Evaluation, Scores
from msdgs_train.evaluation.sheets import Panel, draw_sheet

FOLDER = "eval"
SHEET_ROWS = 8
MAX_PANEL = 320  # pixels of width; smaller images are enlarged to MIN_PANEL or more
MIN_PANEL = 200
FULL_ERROR = 0.25  # mean over the channels that gets the last color; fixed, so that sheets can be compared
OUTLINE = (0, 220, 255)

HEADINGS = {
    "psnr": "PSNR, dB ↑",
    "ssim": "SSIM ↑",
    "lpips": "LPIPS ↓",
    "lpips_01": "LPIPS of [0, 1] ↓",
    "flip": "ꟻLIP ↓",
    "moving_psnr": "moving PSNR, dB ↑",
}


def write_evaluation(run: Path, evaluation: Evaluation) -> list[Path]:
    """Write `<split>.png`, `.md` and `.json` to RUN/eval, each atomically and the JSON last; returns their paths."""
    folder = run / FOLDER
    folder.mkdir(exist_ok=True)
    image, table, numbers = (folder / f"{evaluation.split}.{kind}" for kind in ("png", "md", "json"))
    draw_contact_sheet(image, evaluation)
    write_text(table, as_markdown(evaluation))
    write_text(numbers, json.dumps(as_json(evaluation), indent=2, ensure_ascii=False) + "\n")
    return [image, table, numbers]


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """Return the evaluation as plain values for JSON; an unavailable score is null."""
    return {
        "data": str(evaluation.data),
        "split": evaluation.split,
        "moving_region": {
            "source": evaluation.region_source,
            "share": float(np.mean([mask.mean() for mask in evaluation.masks])),
        },
        "unavailable": evaluation.unavailable,
        "best": evaluation.best and {"split": evaluation.best.split, "psnr": evaluation.best.psnr},
        "models": {evaluated.name: _model_as_json(evaluation, evaluated) for evaluated in evaluation.models},
    }


def as_markdown(evaluation: Evaluation) -> str:
    """Return Markdown tables of the means of each model and of its images, with notes."""
    rows = [
        [m.name, FILES[m.name], f"{m.loaded.step:,}", f"{m.loaded.size:,}", *cells(evaluation, m.mean)]
        for m in evaluation.models
    ]
    parts = [f"# Split `{evaluation.split}`, {len(evaluation.frames)} images of {evaluation.data}"]
    parts += [
        markdown_table(["model", "file", "step", "Gaussians or vertices", *HEADINGS.values()], rows),
        *notes(evaluation),
    ]
    for evaluated in evaluation.models:
        images = [
            [frame.name, f"{frame.t:.4g}", *cells(evaluation, scores), f"{100 * mask.mean():.1f} %"]
            for frame, scores, mask in zip(evaluation.frames, evaluated.images, evaluation.masks, strict=True)
        ]
        parts += [f"## {evaluated.name}", markdown_table(["image", "t", *HEADINGS.values(), "moving region"], images)]
    return "\n\n".join(parts) + "\n"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in [header, ["---"] * len(header), *rows])


def cells(evaluation: Evaluation, scores: Scores) -> list[str]:
    """Format the scores, in the order of `HEADINGS`."""
    digits = {"psnr": 2, "moving_psnr": 2}
    return [
        f"{value:.{digits.get(name, 4)}f}"
        if value is not None
        else ("unavailable" if name in evaluation.unavailable else "nothing moves")
        for name, value in scores._asdict().items()
    ]


def notes(evaluation: Evaluation) -> list[str]:
    """Return the lines below the table."""
    lines = []
    if evaluation.region_source != "none":
        source = {"images": "the images", "model": "the models"}[evaluation.region_source]
        percent = 100 * float(np.mean([mask.mean() for mask in evaluation.masks]))
        lines.append(
            f"moving region: {percent:.1f} % of the pixels, determined from {source}; the same for all models."
        )
    if evaluation.differing:
        lines.append(f"data: not as in training; {evaluation.data} differs in {', '.join(evaluation.differing)}.")
    if evaluation.best is not None:
        best = evaluation.best
        lines.append(f"best: highest PSNR on `{best.split}` during training, {best.psnr:.2f} dB.")
    elif len(evaluation.models) < len(FILES):
        lines.append(f"best: this run has no {FILES['best']}.")
    masked = sum(frame.is_masked for frame in evaluation.frames)
    if masked:
        line = f"masks: {masked} of {len(evaluation.frames)} images have pixels that don't count; "
        lines.append(line + "scores are over the others, LPIPS and ꟻLIP over all, without an error in those.")
    return [*lines, *(f"{HEADINGS[name][:-2]}: unavailable, {why}." for name, why in evaluation.unavailable.items())]


def draw_contact_sheet(path: Path, evaluation: Evaluation) -> None:
    """Draw one row per frame, evenly spaced from the last model's worst to its best: the image, then the rendering of
    each model and its error, with the moving region outlined. Atomic."""
    last, *others = evaluation.models
    models = [last, *(best for best in others if best.loaded.step != last.loaded.step)]
    by_psnr = sorted(range(len(evaluation.frames)), key=lambda index: last.images[index].psnr)
    rows = [_row(evaluation, models, by_psnr[place]) for place in _evenly_spaced(len(by_psnr))]
    shown = "" if len(rows) == len(by_psnr) else f"{len(rows)} of "
    names = " and ".join(f"{evaluated.name} (step {evaluated.loaded.step:,})" for evaluated in models)
    title = f"{evaluation.split}, {shown}{len(by_psnr)} frames, worst first: {names}"
    draw_sheet(path, f"{title}. Error: black 0, yellow ≥ {FULL_ERROR}", rows)


def draw_runs(path: Path, runs: dict[str, Evaluation]) -> None:
    """Draw several runs on the same split: one row per frame, with the image and the last model of each run.
    Atomic. Raises `InvalidInput` unless all were evaluated on the same frames."""
    first, *others = runs.values()
    names = [frame.name for frame in first.frames]
    if any([frame.name for frame in other.frames] != names for other in others):
        raise InvalidInput("RUN", "runs on the same images", "others")
    models = [evaluation.models[0]._replace(name=Path(run).name) for run, evaluation in runs.items()]
    rows = [_row(first, models, index, errors=False) for index in _evenly_spaced(len(names))]
    draw_sheet(path, f"{first.split}, {len(rows)} of {len(names)} frames: {', '.join(runs)}", rows)


def _evenly_spaced(count: int) -> list[int]:
    """Return up to `SHEET_ROWS` evenly spaced numbers from 0 to `count` - 1."""
    return [round(place) for place in np.linspace(0, count - 1, min(SHEET_ROWS, count))]


def _row(evaluation: Evaluation, models: list[EvaluatedModel], index: int, errors: bool = True) -> list[Panel]:
    """Return panels of the image of a frame and its rendering by each model, each with its error if `errors`."""
    frame, mask = evaluation.frames[index], evaluation.masks[index]
    target, counts = models[0].image(frame).numpy(), frame.load_mask()
    row = [_panel(to_bytes(target), f"{frame.name}, t = {frame.t:.3g}")]
    for evaluated in models:
        scores, rgb = evaluated.images[index], evaluated.render(frame).numpy()
        moving = "" if scores.moving_psnr is None else f", moving {scores.moving_psnr:.1f}"
        row.append(_panel(to_bytes(rgb), f"{evaluated.name}: {scores.psnr:.1f} dB{moving}"))
        if errors:
            relative = np.abs(rgb - target).mean(axis=-1) / FULL_ERROR
            relative = relative if counts is None else relative * counts
            error = colormaps["magma"](np.clip(relative, 0, 1), bytes=True)[..., :3]
            error[_outline(mask)] = OUTLINE
            row.append(_panel(error, "error" + (", moving region outlined" if mask.any() else "")))
    return row


def _outline(mask: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, the pixels outside of the mask that border it, so that the inside isn't covered."""
    padded = np.pad(mask, 1)
    return ~mask & (padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:])


def _panel(pixels: np.ndarray, caption: str) -> Panel:
    """Return a panel with uint8 [H, W, 3], enlarged or downscaled to its width."""
    height, width, _ = pixels.shape
    if width <= MAX_PANEL:
        times = -(-MIN_PANEL // width)
        return Panel(pixels.repeat(times, axis=0).repeat(times, axis=1), caption)
    opaque = np.concatenate([pixels, np.full((height, width, 1), 255, np.uint8)], axis=2)
    return Panel(resize_area(opaque, MAX_PANEL, max(1, round(height * MAX_PANEL / width)))[..., :3], caption)


def _model_as_json(evaluation: Evaluation, evaluated: EvaluatedModel) -> dict[str, Any]:
    images = [
        {"name": frame.name, "t": frame.t, **scores._asdict(), "moving_share": float(mask.mean())}
        for frame, scores, mask in zip(evaluation.frames, evaluated.images, evaluation.masks, strict=True)
    ]
    return {
        "file": FILES[evaluated.name],
        "step": evaluated.loaded.step,
        "gaussians": evaluated.loaded.size,
        "mean": evaluated.mean._asdict(),
        "images": images,
    }
