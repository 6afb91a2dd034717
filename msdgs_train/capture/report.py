"""The report of a capture: `capture.html`, one file without links to others, and the same figures as `capture.json`."""

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np

from msdgs_serve.writing import write_text
from msdgs_train.capture.figures import draw_parallax, draw_path
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.image_files import read_color, read_gray
from msdgs_train.capture.masked_poses import MaskedPoses
from msdgs_train.capture.measures import Measures
from msdgs_train.capture.progress import Progress
from msdgs_train.capture.sparse_model import Summary
from msdgs_train.capture.verdict import Verdict
from msdgs_train.capture.views import spread

SHOWN = 24
"""Frames on the contact sheet."""
THUMBNAIL = 300
"""Longer side of a picture on the contact sheet, pixels."""
QUALITY = 75
MOVING = np.array([60, 40, 220])
"""The color of what moves, BGR."""
PAGE = Path(__file__).with_name("report.html")


@dataclass(frozen=True)
class Report:
    """What is reported."""

    frames: FrameSet
    measures: Measures
    verdict: Verdict
    images: Path
    found: MaskedPoses | None
    """None before poses were sought; they may be of no frame."""

    @property
    def moving(self) -> Mapping[str, float]:
        """Share of each frame that moves, if masks were made."""
        return self.found.moving if self.found else {}

    @property
    def model(self) -> Summary | None:
        """The poses and points, if there are any points: COLMAP may leave poses without one."""
        return self.found.poses.summary if self.found and len(self.found.poses.summary.observations) else None


def write_report(report: Report, folder: Path, progress: Progress) -> None:
    """Write `capture.json` and `capture.html` to a folder."""
    parallax = _parallax(report)
    write_text(folder / "capture.json", json.dumps(_plain(report, parallax), indent=1) + "\n")
    drawings = {"path": "", "parallax": ""}
    if report.model is not None:
        cameras = {frame.name: frame.camera for frame in report.frames.frames}
        of_images = np.array([cameras[str(name)] for name in report.model.names])
        drawings["path"] = f"<div class=pair>{''.join(draw_path(report.model, of_images))}</div>"
        drawings["parallax"] = draw_parallax(report.frames, parallax)
    page = Template(PAGE.read_text(encoding="utf-8")).substitute(
        level=report.verdict.level.replace(" ", "-"),
        verdict=_verdict(report.verdict),
        figures="".join(_row(name, value) for name, value in figures(report.measures)),
        path=_section("Cameras and points", drawings["path"]),
        parallax=_section("Parallax a frame", drawings["parallax"]),
        notes="".join(f"<p>{escape(note)}</p>" for note in report.frames.notes),
        sheet="".join(_sheet(report, progress)),
    )
    write_text(folder / "capture.html", page)


def figures(measures: Measures) -> Iterator[tuple[str, str]]:
    """The table of figures: what is measured, and its value in words."""
    yield "frames with a pose", f"{measures.registered} of {measures.frames}"
    yield "taken from", f"{measures.available:,} frames, {measures.seconds:.1f} s, {measures.cameras} camera(s)"
    yield "cameras that stand still", f"{measures.fixed}"
    yield "reprojection error", f"{measures.reprojection_error:.2f} pixels"
    yield "parallax, median of the frames", f"{measures.parallax:.1f}°"
    yield "baseline over depth", f"{measures.baseline:.2f}"
    yield "motion that no rotation explains", f"{measures.beyond_rotation:.1f} pixels"
    if measures.fixed < measures.cameras:
        yield "agrees with the poses, of what frames share", f"{min(measures.agreement, 1):.0%}"
    yield "moves, of the image", f"{measures.moving:.0%}"
    yield "intervals left out as blurred", f"{measures.blurred}"
    yield "black, of the recording", f"{measures.black:.0%}"
    yield "cuts", ", ".join(f"{cut:.1f} s" for cut in measures.cuts) or "none"
    yield "points", f"{measures.points:,}; {measures.seen:.0f} in a frame"
    yield "mapper", measures.method or "none"
    yield "keyframes of other models", ", ".join(map(str, measures.other_models)) or "none"


def _parallax(report: Report) -> dict[str, float]:
    """Degrees by the name of a frame with a pose."""
    if report.model is None:
        return {}
    names = map(str, report.model.names)
    return dict(zip(names, report.measures.parallax_of_frames, strict=True))


def _plain(report: Report, parallax: Mapping[str, float]) -> dict[str, Any]:
    measures = asdict(report.measures)
    del measures["parallax_of_frames"]
    frames = [
        {
            "name": frame.name,
            "time": frame.time,
            "sharpness": frame.sharpness,
            "parallax": parallax.get(frame.name),
            "moving": report.moving.get(frame.name),
        }
        for frame in report.frames.frames
    ]
    verdict = {"level": report.verdict.level, "findings": [asdict(finding) for finding in report.verdict.findings]}
    return {"verdict": verdict, "notes": report.frames.notes, **measures, "frames_taken": frames}


def _verdict(verdict: Verdict) -> str:
    first, *findings = verdict.text.splitlines()
    return f"<p class=level>{escape(first)}</p>" + "".join(f"<p>{escape(finding)}</p>" for finding in findings)


def _row(name: str, value: str) -> str:
    return f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>"


def _section(title: str, drawing: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{drawing}</section>" if drawing else ""


def _sheet(report: Report, progress: Progress) -> Iterator[str]:
    frames = spread(report.frames.frames, SHOWN)
    for done, frame in enumerate(frames, start=1):
        name = frame.name
        coded = base64.b64encode(
            _thumbnail(report.images / name, report.found.masks / name if report.found else None)
        ).decode()
        caption = f"{frame.time:.2f} s" + (f", {report.moving[name]:.0%} moves" if name in report.moving else "")
        yield (
            f'<figure><img alt="{escape(name)}" src="data:image/jpeg;base64,{coded}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
        progress("pictures", done, len(frames))


def _thumbnail(image: Path, mask: Path | None) -> bytes:
    """A frame as JPEG, with what moves in red, where it has a mask."""
    picture = _reduced(read_color(image))
    if mask is not None:
        moves = _reduced(read_gray(mask))[..., None] / 255
        picture = np.round(picture * (1 - 0.55 * moves) + 0.55 * moves * MOVING).astype(np.uint8)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def _reduced(picture: np.ndarray) -> np.ndarray:
    scale = min(1.0, THUMBNAIL / max(picture.shape[:2]))
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
