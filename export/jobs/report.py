"""What a sweep has found, for people and programs: `model.report.json`, `.md` and `.png` beside the scene file."""

import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from export.jobs.figure import draw
from export.jobs.job import CAMERAS_A_TIME, DECIDING_TIMES, MEASURING_TIMES, Job
from export.jobs.points import DEFAULT_RASTERIZER, front
from export.jobs.sweep import SweepResult
from msdgs_serve import __version__
from msdgs_serve.threads import thread_count
from msdgs_train.engine.files import replacing, write_text

FORMAT = "msdgs-report/1"
COLUMNS = ("", "plan", "trimmed to", "SH", "rasterizer", "moving", "still", "ms", "median", "deform", "draw", "MB",
           "memory", "worst frame", "mean", "worst pixel", "position", "px", "images")  # fmt: skip
LEGEND = """\
- **◆ on the front**: no other point is both faster and closer. **★ chosen**: the fastest within the error allowed.
- **trimmed to**: dB on the worst frame that leaving things out may cost; "–": nothing was left out.
- **ms**: a frame, deformation and rasterization together; least and median of interleaved repeats, mean of three views.
- **memory**: at the peak of loading the file and drawing a frame, above what the process holds anyway.
- **worst frame**, **mean**: PSNR in dB against frames of the exact network, deformation and rasterizer in float64.
- **worst pixel**: largest difference of a channel, out of 1. **position**, **px**: how far a Gaussian is at most from
  where it belongs, in scene units and in pixels, faint and hidden ones included.
- **images**: mean PSNR in dB against images that training has not seen.
- Points with other rasterizer options show what these would buy; no file asks for them, so none is chosen.
"""


def report(job: Job, result: SweepResult) -> dict[str, Any]:
    """The whole report as plain values. Errors are the same for the same model; times are this machine's."""
    ahead = set(front(result.points))
    points = [
        {"front": i in ahead, "chosen": i == result.chosen, **point.to_plain()} for i, point in enumerate(result.points)
    ]
    return {
        "format": FORMAT,
        "package_version": __version__,
        "checkpoint_sha256": job.sha256,
        "machine": {"processor": processor(), "threads": thread_count(), "system": platform.platform()},
        "min_psnr": job.min_psnr,
        "views": {
            "cameras": len(job.cameras),
            "measured_frames": len(job.exact.views),
            "measured_times": MEASURING_TIMES,
            "cameras_a_time": CAMERAS_A_TIME,
            "deciding_times": DECIDING_TIMES,
            "width": job.exact.views[0].camera.width,
            "height": job.exact.views[0].camera.height,
        },
        "exact_photographs_psnr": result.exact_images_db,
        "points": points,
        "dropped": [look.to_plain() for look in result.looks],
        "refused": [{"plan": plan, "why": why} for plan, why in result.refused],
    }


def write_report(contents: dict[str, Any], scene: Path) -> list[Path]:
    """Write the three files beside a scene file, each whole or not at all; returns their paths."""
    paths = [scene.with_suffix(f".report{ending}") for ending in (".json", ".md", ".png")]
    write_text(paths[0], json.dumps(contents, indent=1, allow_nan=False) + "\n")
    write_text(paths[1], markdown(contents, scene.name, paths[2].name))
    with replacing(paths[2]) as temporary:
        draw(contents, temporary)
    return paths


def markdown(contents: dict[str, Any], scene: str, figure: str) -> str:
    """The report as a page."""
    machine, views = contents["machine"], contents["views"]
    exact = contents["exact_photographs_psnr"]
    chosen = next(point for point in contents["points"] if point["chosen"])
    left_out = [f"- {entry['what']}: {entry['count']:,} of {entry['of']:,}" for entry in chosen["left_out"]]
    where = [
        f"{machine['processor']}, {machine['threads']} threads.",
        f"{views['measured_frames']} frames of {views['width']} × {views['height']} were compared.",
        f"Allowed: {contents['min_psnr']:g} dB on the worst frame.",
        f"The exact network has {exact:.2f} dB against the images." if exact is not None else "",
    ]
    lines = [
        f"# {scene}: error against run time",
        "",
        " ".join(where).strip(),
        "",
        f"![error against milliseconds a frame]({figure})",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "---|" * len(COLUMNS),
        *("| " + " | ".join(row) + " |" for row in rows(contents)),
        "",
        LEGEND,
        gain(contents),
        "",
        f"After a quick look {len(contents['dropped'])} more candidates were left: others were faster and closer.",
        "",
        "Left out of the chosen file:" if left_out else "Nothing was left out of the chosen file.",
        "",
        *left_out,
    ]
    return "\n".join(lines) + "\n"


def gain(contents: dict[str, Any]) -> str:
    """One sentence: what the chosen point takes against all layers as trained, where these were measured."""
    points, views = contents["points"], contents["views"]
    chosen = next(point for point in points if point["chosen"])
    whole = [p for p in points if p["plan"] == "network" and p["trim_db"] is None and not p["chosen"]]
    took, drawing = (chosen["milliseconds"][part]["min"] for part in ("deformation", "rasterization"))
    text = f"Deformation takes {took:.1f} ms a frame, drawing {drawing:.1f} ms at {views['width']} × {views['height']}"
    if not whole:
        return f"{text}."
    before = whole[0]["milliseconds"]["deformation"]["min"]
    return f"{text}; all layers for all Gaussians take {before:,.1f} ms, {before / max(took, 1e-3):,.1f} times as long."


def rows(contents: dict[str, Any]) -> list[Sequence[str]]:
    """The points as texts, one for each of `COLUMNS`, the slowest first."""
    ordered = sorted(contents["points"], key=lambda point: -point["milliseconds"]["total"]["min"])
    return [_row(point) for point in ordered]


def _row(point: dict[str, Any]) -> list[str]:
    times, error = point["milliseconds"], point["error"]
    mark = "★" if point["chosen"] else "◆" if point["front"] else ""
    memory, images = point["memory_bytes"], point["photographs_psnr"]
    return [
        mark,
        point["plan"],
        "–" if point["trim_db"] is None else f"{point['trim_db']:g} dB",
        str(point["sh_degree"]),
        "" if point["rasterizer"] == DEFAULT_RASTERIZER else point["rasterizer"],
        f"{point['moving']:,}",
        f"{point['static']:,}",
        f"{times['total']['min']:.1f}",
        f"{times['total']['median']:.1f}",
        f"{times['deformation']['min']:.1f}",
        f"{times['rasterization']['min']:.1f}",
        f"{point['bytes'] / 1e6:.2f}",
        "–" if memory is None else f"{memory / 1e6:.0f} MB",
        f"{error['psnr_worst']:.1f}",
        f"{error['psnr_mean']:.1f}",
        f"{error['worst_pixel']:.3f}",
        f"{error['position']:.1e}",
        f"{error['position_pixels']:.2g}",
        "–" if images is None else f"{images:.2f}",
    ]


def processor() -> str:
    """The processor's name as the system gives it."""
    cpuinfo = Path("/proc/cpuinfo")
    names = (
        [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")] if cpuinfo.exists() else []
    )
    return names[0].split(":", 1)[1].strip() if names else platform.processor() or platform.machine()
