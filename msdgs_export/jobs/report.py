"""The report of a sweep: `model.report.json`, `.md` and `.png` beside the scene file."""

import json
import math
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.figure import draw
from msdgs_export.jobs.ruler import CAMERAS_PER_TIME, EVALUATION_TIMES, Ruler
from msdgs_export.jobs.sweep import SweepResult
from msdgs_export.measure.machine import processor
from msdgs_export.plans.base import BASELINE
from msdgs_export.target import Target, squared
from msdgs_serve import __version__
from msdgs_serve.threads import thread_count
from msdgs_serve.writing import replacing, write_text

FORMAT = "msdgs-report/1"
COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "": lambda p: "★" if p["chosen"] else "◆" if p["front"] else "",
    "plan": lambda p: p["plan"],
    "pruned to": lambda p: "–" if p["pruning_db"] is None else f"{p['pruning_db']:g} dB",
    "SH": lambda p: str(p["sh_degree"]),
    "moving": lambda p: f"{p['moving']:,}",
    "static": lambda p: f"{p['static']:,}",
    "ms": lambda p: f"{p['milliseconds']['total']['min']:.1f}",
    "median": lambda p: f"{p['milliseconds']['total']['median']:.1f}",
    "deform": lambda p: f"{p['milliseconds']['deformation']['min']:.1f}",
    "draw": lambda p: f"{p['milliseconds']['rasterization']['min']:.1f}",
    "MB": lambda p: f"{p['bytes'] / 1e6:.2f}{'' if p['packed'] else ' *'}",
    "memory": lambda p: "–" if p["memory_bytes"] is None else f"{p['memory_bytes'] / 1e6:.0f} MB",
    "worst frame": lambda p: f"{p['error']['psnr_worst']:.1f}",
    "mean": lambda p: f"{p['error']['psnr_mean']:.1f}",
    "worst pixel": lambda p: f"{p['error']['worst_pixel']:.3f}",
    "position": lambda p: f"{p['error']['position']:.1e}",
    "px": lambda p: f"{p['error']['position_pixels']:.2g}",
    "held-out": lambda p: "–" if p["images_psnr"] is None else f"{p['images_psnr']:.2f}",
}
"""Columns by name, each with a function from a point to its text."""

LEGEND = """\
- **◆ on the front**: no other point is faster, smaller and has a smaller error; compared before the chosen one is
  packed if others aren't. **★ chosen**: the fastest within the error allowed, the smallest of several that
  are about as fast; if bytes alone are limited, the one with the smallest error.
- **pruned to**: lowest PSNR of a frame that pruning alone may cause; "–": not pruned.
- **ms**: per frame, deformation and rasterization; minimum and median of interleaved repeats, mean of three views.
- **memory**: peak while loading the file and drawing a frame, above that of the idle process.
- **worst frame**, **mean**: PSNR in dB against frames of the exact network, deformation and rasterizer in float64.
- **worst pixel**: largest difference of a channel, out of 1. **position**, **px**: largest displacement of
  a Gaussian, in world units and in pixels, transparent and hidden ones included.
- **held-out**: mean PSNR in dB against held-out images.
- **MB**: 10⁶ bytes. MB and errors are those of a file whose arrays have fewer bits, or, if marked *, float32.
"""


def report(checkpoint: Checkpoint, ruler: Ruler, target: Target, result: SweepResult) -> dict[str, Any]:
    """The report as plain values. Errors are reproducible; times are those of this machine."""
    numbered = enumerate(result.points)
    points = [{"front": i in result.front, "chosen": i == result.chosen, **p.to_plain()} for i, p in numbered]
    return {
        "format": FORMAT,
        "package_version": __version__,
        "checkpoint_sha256": checkpoint.sha256,
        "machine": {"processor": processor(), "threads": thread_count(), "system": platform.platform()},
        "min_psnr": None if target.bytes_only else target.min_psnr,
        "max_bytes": target.max_bytes,
        "views": {
            "cameras": len(ruler.cameras),
            "evaluation_frames": len(ruler.views),
            "evaluation_times": EVALUATION_TIMES,
            "cameras_per_time": CAMERAS_PER_TIME,
            "width": ruler.views[0].camera.width,
            "height": ruler.views[0].camera.height,
        },
        "exact_images_psnr": ruler.exact_images_psnr,
        "points": points,
        "dropped": [estimate.to_plain() for estimate in result.estimates],
        "refused": [{"plan": plan, "why": why} for plan, why in result.refused],
    }


def write_report(contents: dict[str, Any], scene: Path) -> list[Path]:
    """Write the three files beside a scene file, each atomically; returns their paths."""
    paths = [scene.with_suffix(f".report{ending}") for ending in (".json", ".md", ".png")]
    write_text(paths[0], json.dumps(contents, indent=1, allow_nan=False) + "\n")
    write_text(paths[1], markdown(contents, scene.name, paths[2].name))
    with replacing(paths[2]) as temporary:
        draw(contents, temporary)
    return paths


def markdown(contents: dict[str, Any], scene: str, figure: str) -> str:
    """The report as Markdown."""
    machine, views = contents["machine"], contents["views"]
    chosen = next(point for point in contents["points"] if point["chosen"])
    left_out = [f"- {entry['what']}: {entry['count']:,} of {entry['of']:,}" for entry in chosen["left_out"]]
    summary = [
        f"{machine['processor']}, {machine['threads']} threads.",
        f"{views['evaluation_frames']} frames of {views['width']} × {views['height']} were compared.",
        _limits(contents),
    ]
    lines = [
        f"# {scene}: error against run time and bytes",
        "",
        " ".join(summary).strip(),
        "",
        f"![error against milliseconds per frame, and against megabytes]({figure})",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "---|" * len(COLUMNS),
        *("| " + " | ".join(row) + " |" for row in rows(contents)),
        "",
        LEGEND,
        gain(contents),
        "",
        f"{len(contents['dropped'])} more candidates were dropped after a quick estimate: others are better, or fit.",
        "",
        "Pruned from the chosen file:" if left_out else "Nothing was pruned from the chosen file.",
        "",
        *left_out,
    ]
    return "\n".join(lines) + "\n"


def _limits(contents: dict[str, Any]) -> str:
    """What was allowed, and what this means for the error against held-out images."""
    exact, min_psnr, max_bytes = (contents[name] for name in ("exact_images_psnr", "min_psnr", "max_bytes"))
    texts = ["" if min_psnr is None else f"{min_psnr:g} dB on the worst frame", max_bytes and f"{max_bytes / 1e6:g} MB"]
    allowed = f"Allowed: {' and '.join(filter(None, texts))}."
    if exact is None:
        return allowed
    added = "" if min_psnr is None else f", {10 * math.log10(1 + squared(min_psnr - exact)):.2f} less with this error"
    return f"{allowed} The exact network has {exact:.2f} dB against held-out images{added}."


def gain(contents: dict[str, Any]) -> str:
    """One sentence: times of the chosen point, and against all layers as trained if these were measured."""
    points, views = contents["points"], contents["views"]
    chosen = next(point for point in points if point["chosen"])
    whole = [p for p in points if p["plan"] == BASELINE and p["pruning_db"] is None and not p["chosen"]]
    took, drawing = (chosen["milliseconds"][part]["min"] for part in ("deformation", "rasterization"))
    text = (
        f"Deformation takes {took:.1f} ms per frame, drawing {drawing:.1f} ms at {views['width']} × {views['height']}"
    )
    if not whole:
        return f"{text}."
    before = whole[0]["milliseconds"]["deformation"]["min"]
    return f"{text}; all layers for all Gaussians take {before:,.1f} ms, {before / max(took, 1e-3):,.1f} times as long."


def rows(contents: dict[str, Any]) -> list[list[str]]:
    """The points as texts, one for each of `COLUMNS`, the slowest first."""
    ordered = sorted(contents["points"], key=lambda point: -point["milliseconds"]["total"]["min"])
    return [[text(point) for text in COLUMNS.values()] for point in ordered]
