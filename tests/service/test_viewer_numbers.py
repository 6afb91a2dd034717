"""What the page's modules make of numbers: texts for people, and the facts about scenes of each kind."""

from typing import Any

import pytest
from playwright.sync_api import Page

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("call", "text"),
    [
        ("size(0)", "0 bytes"),
        ("size(999)", "999 bytes"),
        ("size(1500)", "1.5 kB"),
        ("size(2781092)", "2.8 MB"),
        ("size(999999)", "1.0 MB"),
        ("size(123456789)", "123 MB"),
        ("size(5e15)", "5000 TB"),
        ("count(1234567)", "1,234,567"),
        ("plain(0)", "0"),
        ("plain(0.00421)", "0.00421"),
        ("plain(12.3456)", "12.3"),
        ("plain(-3.2e-7)", "-3.2 × 10⁻⁷"),
        ("plain(1.5e12)", "1.5 × 10¹²"),
        ("decibels(51.3026)", "51.3 dB"),
        ("duration(0)", "0 ms"),
        ("duration(0.00168)", "1.7 ms"),
        ("duration(0.0148)", "15 ms"),
        ("duration(0.9999)", "1 s"),
        ("duration(12.5)", "12.5 s"),
        ("inRange(0.25, 1)", "0.250"),
        ("inRange(1234.5678, 1000)", "1235"),
        ("inRange(123456.7812, 0.12)", "123456.7812"),
        ("inRange(2, 0)", "2.000"),
    ],
)
def test_numbers_are_for_people(modules: Page, call: str, text: str):
    assert modules.evaluate(f"""async () => {{
        const {{ count, decibels, duration, inRange, plain, size }} = await import("/viewer/numbers.js");
        return {call}; }}""") == text  # fmt: skip


STATIC: dict[str, Any] = {
    "gaussians": {"moving": 0, "static": 1234567, "total": 1234567},
    "changes": False,
    "motion": False,
    "time_range": [0, 1],
    "duration": None,
    "layers": [],
    "plan": "network",
    "measured_error": {"means": 0.0},
    "left_out": [],
    "cameras": [],
    "sha256": "0123456789abcdef",
}
DYNAMIC = STATIC | {
    "gaussians": {"moving": 9307, "static": 9068, "total": 18375},
    "changes": True,
    "motion": True,
    "time_range": [1 / 30, 2],
    "duration": 2.5,
    "layers": ["spline", "mlp", "mlp"],
    "measured_error": {"position": 5.55e-7, "rendered": {"psnr_worst": 51.3026}},
    "cameras": [{}] * 8,
}
SWITCHED = STATIC | {
    "gaussians": {"moving": 2100, "static": 0, "total": 2100},
    "changes": True,
    "plan": "frames:3",
    "left_out": [
        {"rule": "float32", "what": "bytes", "count": 2781092, "of": 4878736, "worst_frame_db": 66.04},
        {"rule": "static", "what": "motion", "count": 9068, "of": 18375},
        "nonsense",
        None,
    ],
}
COMPACT = DYNAMIC | {"plan": "compact:50", "measured_error": {"means": 3.2e-4}, "layers": ["mlp"]}


@pytest.mark.parametrize(
    ("described", "facts"),
    [
        (STATIC, ["Gaussians 1,234,567", "Deformation none, the scene is static", "Error none"]),
        (
            DYNAMIC,
            [
                "Gaussians 18,375, 9,307 of them moving",
                "Time 0.033 to 2, 2.5 s",
                "Deformation spline, then 2 × mlp",
                "Plan network (all layers)",
                "Error 51.3 dB in the worst frame",
                "Cameras 8",
            ],
        ),
        (
            SWITCHED,
            [
                "Gaussians 2,100",
                "Time 0 to 1",
                "Plan frames:3 (the nearest of the frames)",
                "Error 66.0 dB in the worst frame",
                "Left out 2.8 MB of 4.9 MB, by fewer bits per number",
                "motion: 9,068 of 18,375",
            ],
        ),
        (
            COMPACT,
            [
                "Gaussians 18,375, 9,307 of them moving",
                "Time 0.033 to 2, 2.5 s",
                "Deformation mlp",
                "Plan compact:50 (fitted curves)",
                "Error at most 0.032 % of the scene’s size",
                "Cameras 8",
            ],
        ),
    ],
)
def test_the_facts_of_each_kind_of_scene(modules: Page, described: dict[str, Any], facts: list[str]):
    script = """async (scene) => {
        const { showFacts } = await import("/viewer/facts.js");
        const list = document.createElement("dl");
        showFacts(list, scene);
        return [...list.children].map((each) => (each.tagName === "dt" ? "|" : "") + each.textContent).join(" "); }"""
    texts = modules.evaluate(script, described)
    for fact in [*facts, "SHA-256 0123456789ab"]:
        assert fact in texts.replace("|", ""), texts
    terms = [fact.split()[0] for fact in facts if not fact.startswith("motion")]
    assert [part.split()[0] for part in texts.split("|")[1:] if not part.startswith(("Left", "SHA"))] == [
        term for term in terms if term != "Left"
    ]
