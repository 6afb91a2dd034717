"""The report is one file with the verdict first, the figures, drawings and pictures, and no link to others."""

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser

from msdgs_train.capture.masked_poses import MaskedPoses
from msdgs_train.capture.measures import measure_frames, measure_poses
from msdgs_train.capture.report import Report, figures, write_report
from msdgs_train.capture.verdict import judge
from tests.support.processes import chromium
from tests.train.capture.made_capture import made_frames, made_model, made_poses, write_images


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report on a capture whose frames are named like elements of HTML; read-only."""
    folder = tmp_path_factory.mktemp("report")
    frames = made_frames(cuts=(0.85,))
    write_images(frames, folder / "images", folder / "masks")
    poses = made_poses(made_model(frames))
    moving = {frame.name: 0.5 for frame in frames.frames}
    measures = measure_poses(measure_frames(frames), frames, poses, moving)
    found = MaskedPoses(poses, folder / "masks", moving)
    report = Report(frames, measures, judge(measures), folder / "images", found)
    pictures: list[int] = []
    write_report(report, folder, lambda stage, done, total: pictures.append(done))
    assert pictures == list(range(1, 17))
    return folder


class Page(HTMLParser):
    """Elements of a page with what they refer to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.references: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")]


def test_the_page_needs_nothing_else(reported: Path):
    text = (reported / "capture.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not {"script", "link", "iframe", "object", "form"} & set(page.tags)
    assert [each[:40] for each in page.references if not each.startswith(("data:image/", "#"))] == []
    assert re.findall(r"url\((?!#)[^)]*\)|@import", text) == []
    assert page.tags.count("img") == 16
    assert page.tags.count("svg") == 3
    assert "contains pictures of the recording" in text


def test_the_verdict_comes_first(reported: Path):
    text = (reported / "capture.html").read_text(encoding="utf-8")
    assert text.index("usable, and better") < text.index("16 frames are few") < text.index("<h2>")


def test_all_figures_are_shown_and_in_the_json(reported: Path):
    stored = json.loads((reported / "capture.json").read_text(encoding="utf-8"))
    assert stored["verdict"]["level"] == "usable"
    assert [frame["name"] for frame in stored["frames_taken"]] == [f"{index:05d}.png" for index in range(16)]
    assert all(frame["parallax"] > 1 and frame["moving"] == 0.5 for frame in stored["frames_taken"])
    assert (stored["registered"], stored["other_models"], stored["cuts"]) == (16, [5, 3], [0.85])
    text = (reported / "capture.html").read_text(encoding="utf-8")
    for words in ("16 of 16", "0.40 pixels", "50%", "0.8 s", "5, 3"):
        assert f"<td>{words}" in text


def test_masks_are_drawn_over_the_pictures(reported: Path):
    text = (reported / "capture.html").read_text(encoding="utf-8")
    coded = re.findall(r"data:image/jpeg;base64,([^\"]+)", text)
    image = cv2.imdecode(np.frombuffer(base64.b64decode(coded[0]), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    image = image.astype(float)
    redness = image[..., 2] - image[..., :2].mean(axis=2)
    assert redness[:, :40].mean() > 60 > 20 > abs(redness[:, 56:].mean())


def test_names_are_escaped(tmp_path: Path):
    frames = made_frames(1)
    hostile = type(frames.frames[0])("<b>&.png", 0, 0.0, 1.0)
    frames = type(frames)(frames.cameras, (hostile,))
    write_images(frames, tmp_path / "images", tmp_path / "masks")
    measures = measure_frames(frames)
    write_report(Report(frames, measures, judge(measures), tmp_path / "images", None), tmp_path, lambda *_: None)
    text = (tmp_path / "capture.html").read_text(encoding="utf-8")
    assert "<b>" not in text
    assert 'alt="&lt;b&gt;&amp;.png"' in text


def test_poses_without_points_are_reported(tmp_path: Path):
    frames = made_frames()
    write_images(frames, tmp_path / "images", tmp_path / "masks")
    poses = made_poses(made_model(frames, points=0))
    measures = measure_poses(measure_frames(frames), frames, poses, {})
    found = MaskedPoses(poses, tmp_path / "masks", {})
    write_report(Report(frames, measures, judge(measures), tmp_path / "images", found), tmp_path, lambda *_: None)
    assert judge(measures).level == "no scene"
    assert "<svg" not in (tmp_path / "capture.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_a_browser_shows_it_from_a_file(browser: Browser, reported: Path, width: int):
    with browser.new_context(viewport={"width": width, "height": 800}) as context:
        page = context.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(f"file://{reported}/capture.html")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate("[...document.images].every((image) => image.naturalWidth > 0)")
        drawn = page.evaluate("[...document.querySelectorAll('svg')].map((svg) => svg.getBoundingClientRect().width)")
        assert all(0.4 * width < each <= width for each in drawn)
        assert [url[:60] for url in asked if not url.startswith(("file:", "data:"))] == []


def test_every_figure_has_a_row(reported: Path):
    frames = made_frames()
    rows = dict(figures(measure_frames(frames)))
    assert rows["frames with a pose"] == "0 of 16"
    assert rows["cuts"] == rows["mapper"] == "none"
