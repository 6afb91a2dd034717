"""The sweep and its report: dominated points are never chosen, errors repeat, invalid options are refused."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, get_args

import numpy as np
import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from msdgs_export.cli.to_onnx import main
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.estimates import QuickEstimate, to_measure
from msdgs_export.jobs.points import TIME_MARGIN, Point, choose, front
from msdgs_export.jobs.report import COLUMNS, FORMAT, gain, report, rows, write_report
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.sweep import SweepResult
from msdgs_export.jobs.timing import FrameTime, Milliseconds
from msdgs_export.measure.poses import Pose
from msdgs_export.measure.rendered_error import RenderedError
from msdgs_export.options import ExportOptions, Kept
from msdgs_export.pruning import RULES
from msdgs_export.target import Target, TargetNotReached, default_min_psnr
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from tests.support.exports import Parts, parts_of
from tests.support.models import GROUND, OBJECT, moving_object, random_model, saved
from tests.support.tolerances import tolerance

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("few_candidates"),
    pytest.mark.xdist_group("work precision"),  # one worker, so that the sweep runs once
]

POINT_FIELDS = {
    "front": bool,
    "chosen": bool,
    "plan": str,
    "pruning_db": (float, type(None)),
    "sh_degree": int,
    "moving": int,
    "static": int,
    "layers": int,
    "bytes": int,
    "packed": bool,
    "memory_bytes": (int, type(None)),
    "milliseconds": dict,
    "error": dict,
    "images_psnr": (float, type(None)),
    "left_out": list,
}


def point(milliseconds: float, db: float, size: int = 1) -> Point:
    times = FrameTime(*(Milliseconds(milliseconds, milliseconds),) * 3)
    error = RenderedError(db, db, None, 0.0, 0.0, 0.0, 1)
    return Point(cast(Any, SimpleNamespace(size=size)), times, error, None, None)


few = st.integers(1, 4)  # so that some are equal
measured = st.lists(st.builds(point, few | st.floats(1, 100), few.map(lambda n: 20 * n), few), min_size=1, max_size=12)


@given(measured, st.floats(20, 100))
def test_no_dominated_point_is_on_the_front_or_chosen(points: list[Point], min_psnr: float):
    ahead = front(points)
    assert ahead
    for i, a in enumerate(points):
        beaten = any(b.costs != a.costs and all(x <= y for x, y in zip(b.costs, a.costs, strict=True)) for b in points)
        first_of_equals = [p.costs for p in points].index(a.costs) == i
        assert (i in ahead) == (first_of_equals and not beaten)
    within = [p for p in points if p.error.psnr_worst >= min_psnr]
    target = Target(min_psnr, packs=False)
    if within:
        best = choose(points, target)
        assert best in ahead
        longest = TIME_MARGIN * min(p.milliseconds for p in within)
        assert points[best].milliseconds <= longest
        assert points[best].candidate.size == min(p.candidate.size for p in within if p.milliseconds <= longest)
    else:
        with pytest.raises(TargetNotReached, match="which a file reaches"):
            choose(points, target)
    finest = choose(points, Target(max_bytes=10, bytes_only=True))
    assert finest in ahead
    assert points[finest].error.psnr_worst == max(p.error.psnr_worst for p in points)


def test_a_point_that_leaves_something_for_storage_is_preferred_if_it_is_about_as_fast():
    tight, exact, slow = point(1.0, 50.5), point(1.1, 52.0, 2), point(2.0, 60.0, 3)
    assert choose([tight, exact, slow], Target(50.0)) == 1
    assert choose([tight, exact, slow], Target(50.0, packs=False)) == 0
    assert choose([tight, slow], Target(50.0)) == 0


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory, few_candidates: None) -> tuple[Parts, SweepResult]:
    parts = new_parts(tmp_path_factory.mktemp("swept"))
    return parts, parts.sweep()


def new_parts(folder: Path) -> Parts:
    (folder / "candidates").mkdir()
    return parts_of(saved(folder, moving_object()), folder / "candidates", Target(45.0))


def report_of(swept: tuple[Parts, SweepResult]) -> dict[str, Any]:
    (checkpoint, _, ruler, target), result = swept
    return report(checkpoint, ruler, target, result)


def test_the_sweep_keeps_the_whole_network_to_compare_with_and_chooses_within_the_error(
    swept: tuple[Parts, SweepResult],
):
    _, result = swept
    whole = [p for p in result.points if p.candidate.plan == "network" and p.candidate.pruning_db is None]
    most = max(p.candidate.sh_degree for p in whole)
    assert sum(p.candidate.sh_degree == most for p in whole) == 1
    within = [p for p in result.points if p.error.psnr_worst >= 45]
    assert result.points[result.chosen].milliseconds <= TIME_MARGIN * min(p.milliseconds for p in within)
    assert any(p.candidate.session.scene.moving_count <= OBJECT for p in within)


def test_what_cannot_be_chosen_is_measured_last(monkeypatch: pytest.MonkeyPatch):
    """Of too many candidates, however fast it is."""
    monkeypatch.setattr("msdgs_export.jobs.estimates.MAX_POINTS", 3)
    measured = ((1.0, 40.0), (2.0, 45.0), (3.0, 51.0), (4.0, 60.0), (5.0, 65.0), (6.0, 70.0))
    estimates = [QuickEstimate(cast(Any, None), cpu, 0.0, db, 1) for cpu, db in measured]
    targets = Target(50.0), Target(max_bytes=10, bytes_only=True)
    kept = [
        [estimate.cpu for estimate in to_measure(some, target)]
        for target in targets
        for some in (estimates, estimates[:3])
    ]
    assert kept == [[3, 4, 5], [3, 1, 2], [6, 5, 4], [3, 2, 1]]


def test_the_report_says_what_was_gained(swept: tuple[Parts, SweepResult]):
    contents = report_of(swept)
    whole = next(p for p in contents["points"] if p["plan"] == "network" and p["pruning_db"] is None)
    chosen = next(p for p in contents["points"] if p["chosen"])
    whole["milliseconds"]["deformation"]["min"], chosen["milliseconds"]["deformation"]["min"] = 1480.0, 3.7
    assert "Deformation takes 3.7 ms per frame" in gain(contents)
    assert "all layers for all Gaussians take 1,480.0 ms, 400.0 times as long." in gain(contents)


def test_the_same_model_has_the_same_errors(swept: tuple[Parts, SweepResult], tmp_path: Path):
    """Up to rounding: libraries may add in another order."""
    again, result = new_parts(tmp_path), swept[1]
    for p in (result.points[result.chosen], result.points[front(result.points)[-1]]):
        c = p.candidate
        lower = c.sh_degree if c.sh_degree < again.builder.pruning.at(c.pruning_db).moving.config.sh_degree else None
        error = again.ruler.error(again.builder.candidate(c.plan, c.pruning_db, lower))
        assert (error.worst_frame, error.frames) == (p.error.worst_frame, p.error.frames)
        found, wanted = (
            (e.psnr_mean, e.psnr_worst, e.worst_pixel, e.position, e.position_pixels) for e in (error, p.error)
        )
        assert found == pytest.approx(wanted, rel=tolerance("float32.relative"))


def test_the_report_has_its_fields(swept: tuple[Parts, SweepResult], tmp_path: Path):
    contents = report_of(swept)
    paths = write_report(contents, tmp_path / "ball.onnx")
    assert [path.name for path in paths] == ["ball.report.json", "ball.report.md", "ball.report.png"]
    read = json.loads(paths[0].read_text())
    assert read == json.loads(json.dumps(contents))
    assert (read["format"], read["min_psnr"]) == (FORMAT, 45.0)
    assert sum(p["chosen"] for p in read["points"]) == 1
    for p in read["points"]:
        assert set(p) == set(POINT_FIELDS)
        for name, kind in POINT_FIELDS.items():
            assert isinstance(p[name], kind), name
        assert set(p["milliseconds"]) == {"deformation", "rasterization", "total"}
        assert set(p["milliseconds"]["total"]) == {"min", "median"}
        assert 0 < p["milliseconds"]["total"]["min"] <= p["milliseconds"]["total"]["median"]
        assert p["moving"] + p["static"] <= GROUND + OBJECT
    page = paths[1].read_text()
    assert page.count("★ |") == 1
    chosen = next(p for p in read["points"] if p["chosen"])  # times of such small files are nearly equal
    assert ("motion of Gaussians that never move visibly" in page) == (chosen["static"] > 0)
    assert all(len(row) == len(COLUMNS) for row in rows(contents))
    with Image.open(paths[2]) as image:
        assert image.format == "PNG"
        assert len(np.unique(np.asarray(image).reshape(-1, 4), axis=0)) > 10


def test_an_error_that_cannot_be_reached_says_what_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = saved(tmp_path, random_model(60))
    assert main(ExportOptions(path, tmp_path / "s.onnx", plan="prefix:1", min_psnr=75.0)) == EXIT_INVALID
    shown = capsys.readouterr().err
    assert "at most" in shown
    assert "which the plan prefix:1 reaches" in shown
    reachable = float(shown.split("at most ")[1].split(",")[0])
    assert main(ExportOptions(path, tmp_path / "s.onnx", plan="prefix:1", min_psnr=reachable)) == 0
    metadata = DeformationSession(tmp_path / "s.onnx").scene.metadata
    assert metadata.plan == "prefix:1"
    assert metadata.measured_error["rendered"]["psnr_worst"] >= reachable


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"plan": "fastest"}, "network"),
        ({"plan": "prefix:9"}, "prefix:k with k from 1 to 2"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"times": 1}, "times"),
        ({"data": Path("nowhere")}, "nowhere"),
        ({"output": Path("nowhere") / "s.onnx"}, "in a folder that exists"),
        ({"model": Path("missing.pt")}, "missing.pt"),
        ({"model": Path("empty.pt")}, "empty.pt"),
        ({"model": Path("text.pt")}, "text.pt"),
        ({"model": Path("folder.pt")}, "folder.pt"),
        *(
            ({"max_mb": value}, "`max_mb` must be a positive number")
            for value in (float("nan"), float("inf"), 0.0, -1.0)
        ),
        *(
            ({"min_psnr": value}, "`min_psnr` must be a PSNR in dB from 10 to 100")
            for value in (float("nan"), float("inf"), -1.0, 0.0, 101.0)
        ),
    ],
)
def test_invalid_options_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    settings: dict[str, Any], message: str,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("empty.pt").touch()
    Path("text.pt").write_text("no model")
    Path("folder.pt").mkdir()
    wishes: dict[str, Any] = {"model": saved(tmp_path, random_model(60)), "output": tmp_path / "s.onnx"} | settings
    assert main(ExportOptions(**wishes)) == EXIT_INVALID
    shown = capsys.readouterr().err
    assert "error: " in shown
    assert message in shown
    assert not (tmp_path / "s.onnx").exists()


def test_for_web_is_a_limit_of_bytes_and_an_error():
    model = Path("model.pt")
    assert ExportOptions(model, for_web=True).spelled_out == ExportOptions(model, max_mb=5.0, min_psnr=40.0)
    own = ExportOptions(model, max_mb=2.0, min_psnr=45.0)
    assert replace(own, for_web=True).spelled_out == own == own.spelled_out


@pytest.mark.parametrize(("plan", "keep"), [(None, ()), ("network", ()), ("network", ("float32",))])
def test_a_limit_of_bytes_is_kept_with_the_error_that_the_file_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plan: str | None, keep: tuple[Kept, ...]
):
    checkpoint, output = saved(tmp_path, moving_object()), tmp_path / "s.onnx"

    def exported(max_mb: float, min_psnr: float | None = None) -> str:
        options = ExportOptions(checkpoint, output, max_mb=max_mb, min_psnr=min_psnr, plan=plan, times=4)
        return capsys.readouterr().err if main(replace(options, keep=keep)) else ""

    refused = exported(0.001)
    assert "`max_mb` must be at least" in refused
    smallest = float(refused.split("at least ")[1].split(",")[0])
    reached, exact = [], Ruler(Checkpoint.load(checkpoint)).exact
    for max_mb in (smallest, 10.0):
        assert not exported(max_mb)
        assert output.stat().st_size <= 1e6 * max_mb
        session = DeformationSession(output)
        rendered = session.scene.metadata.measured_error["rendered"]
        assert exact.measure(session.gaussians, np.zeros(len(session.scene), int)).psnr_worst == rendered["psnr_worst"]
        reached.append(rendered["psnr_worst"])
        if plan is None:
            contents = json.loads((tmp_path / "s.report.json").read_text())
            assert (contents["min_psnr"], contents["max_bytes"]) == (None, round(1e6 * max_mb))
            (chosen,) = (p for p in contents["points"] if p["chosen"])
            assert chosen["bytes"] == output.stat().st_size
            assert chosen["error"] == rendered
    assert f"{reached[0]:.1f} dB on its worst frame" in refused
    assert reached == sorted(reached)
    assert not exported(10.0, min_psnr=45.0)
    removed = {entry["rule"] for entry in DeformationSession(output).scene.metadata.left_out}
    assert removed - {"float32"}, "of those that fit and are good enough, the most pruned is the fastest"
    assert "must be at" in exported(smallest, min_psnr=99.5)


def test_the_default_error_adds_a_twentieth_of_a_decibel_to_that_of_held_out_images():
    for model_db in (18.0, 25.6, 37.3):
        allowed = default_min_psnr(model_db)
        added = [10 * np.log10(1 + 10 ** ((model_db - db) / 10)) for db in (allowed, allowed - 0.1)]
        assert added[0] <= 0.05 < added[1]
    assert default_min_psnr(None) == 50


def test_each_rule_of_pruning_has_a_switch():
    assert get_args(Kept) == (*RULES, "float32")
    options = tyro.cli(ExportOptions, args=["model.pt", "--keep", "heads", "sh", "--quick"])
    assert (options.keep, options.packs) == (("heads", "sh"), True)
    assert not tyro.cli(ExportOptions, args=["model.pt", "--keep", "float32"]).packs


def test_what_else_is_to_be_kept_is_refused_with_what_can_be(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        tyro.cli(ExportOptions, args=["model.pt", "--keep", "head"])
    assert stopped.value.code == 2
    shown = capsys.readouterr().err
    assert all(f"'{part}'" in shown for part in ("head", *get_args(Kept)))


def test_one_command_writes_scene_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(ExportOptions(saved(tmp_path, moving_object()), min_psnr=45.0, keep=("sh",))) == 0
    shown = capsys.readouterr().err
    assert "★" in shown
    scene = DeformationSession(tmp_path / "model.onnx").scene
    # the fastest of such small files is random
    still = scene.moving_count < len(moving_object().gaussians)
    assert ("left out: motion of Gaussians that never move visibly" in shown) == still
    assert scene.metadata.sh_degree == moving_object().config.sh_degree
    assert {"sh", "sh_degree"}.isdisjoint(entry["rule"] for entry in scene.metadata.left_out)
    assert scene.metadata.measured_error["rendered"]["psnr_worst"] >= 45
    contents = json.loads((tmp_path / "model.report.json").read_text())
    chosen = next(p for p in contents["points"] if p["chosen"])
    assert chosen["moving"] == scene.moving_count
    assert chosen["error"] == scene.metadata.measured_error["rendered"]
    assert chosen["left_out"] == list(scene.metadata.left_out)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "model.onnx", "model.pt", "model.report.json", "model.report.md", "model.report.png",
    ]  # fmt: skip


def test_the_chosen_point_of_a_report_is_the_file_that_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def psnr(pose: Pose, options: RasterizerOptions) -> float:
        return 20 + float(pose(0.5).scales.mean(dtype=np.float64))

    images = SimpleNamespace(training=(), psnr=psnr)
    monkeypatch.setattr("msdgs_export.jobs.command._held_out_images", lambda *_: images)
    monkeypatch.setattr(
        "msdgs_export.jobs.points.frame_memory", lambda paths, *_: [path.stat().st_size for path in paths]
    )
    assert main(ExportOptions(saved(tmp_path, moving_object()), min_psnr=45.0)) == 0
    (chosen,) = (p for p in json.loads((tmp_path / "model.report.json").read_text())["points"] if p["chosen"])
    assert chosen["packed"]
    assert chosen["images_psnr"] == psnr(DeformationSession(tmp_path / "model.onnx").gaussians, GSPLAT)
    assert chosen["memory_bytes"] <= chosen["bytes"]


def test_a_plan_of_all_layers_is_written_although_one_has_no_effect(tmp_path: Path):
    assert main(ExportOptions(saved(tmp_path, moving_object()), plan="prefix:2", min_psnr=45.0)) == 0
    scene = DeformationSession(tmp_path / "model.onnx").scene
    assert (scene.metadata.plan, len(scene.metadata.layers)) == ("prefix:2", 2)
    assert 0 < scene.moving_count <= OBJECT


@pytest.mark.parametrize("place", ["msdgs_export.jobs.command.Sweep.run", "msdgs_export.jobs.command.write_scene"])
def test_ctrl_c_leaves_old_files_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    checkpoint = saved(tmp_path, random_model(60))
    old = {name: f"an older {name}".encode() for name in ("model.onnx", "model.report.json")}
    for name, contents in old.items():
        (tmp_path / name).write_bytes(contents)
    monkeypatch.setattr(place, interrupt)
    settings: dict[str, Any] = {} if place.endswith("run") else {"quick": True}
    assert main(ExportOptions(checkpoint, **settings)) == 130
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path != checkpoint} == old
