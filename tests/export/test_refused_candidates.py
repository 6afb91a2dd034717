"""Candidates that can't be made or drawn: they are refused alone, and others are chosen."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from msdgs_export.cli.to_onnx import main
from msdgs_export.jobs.builder import CandidateBuilder
from msdgs_export.jobs.candidate import Candidate
from msdgs_export.jobs.fit_bytes import within_bytes
from msdgs_export.jobs.ruler import ESTIMATE_STRIDE, Ruler
from msdgs_export.measure.poses import Pose
from msdgs_export.measure.rendered_error import RenderedError
from msdgs_export.options import ExportOptions
from msdgs_export.plans.registry import PLANS
from msdgs_export.target import Target, TargetNotReached
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from tests.support.exports import parts_of
from tests.support.models import moving_object, saved

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_candidates")]


@pytest.mark.parametrize("at", ["all times", "one that no estimate tries"])
def test_plans_whose_motion_overflows_in_float32_are_refused_and_fitted_ones_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
):
    parts = parts_of(saved(tmp_path, moving_object()), tmp_path, Target(45.0))
    whole = DeformationSession.pose
    views = parts.ruler.views
    one = ({view.t for view in views} - {view.t for view in views[::ESTIMATE_STRIDE]}).pop()

    def pose(session: DeformationSession, t: float, *args: Any, **kwargs: Any) -> Any:
        if not session.scene.metadata.plan.startswith("compact") and (at == "all times" or t == one):
            raise SceneFileInvalid("scene", "means", "overflow")
        return whole(session, t, *args, **kwargs)

    monkeypatch.setattr(DeformationSession, "pose", pose)
    monkeypatch.setitem(PLANS, "compact", replace(PLANS["compact"], candidates=lambda layers: ["compact:70"]))
    result = parts.sweep()
    assert {plan for plan, why in result.refused if "overflow" in why} == {"network", "prefix:1"}
    assert {point.candidate.plan for point in result.points} == {"compact:70"}


def test_a_file_of_few_bytes_that_overflows_is_refused_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    measure, overflowing, refused = Ruler.error, set[float | None](), list[tuple[str, str]]()

    def error(ruler: Ruler, candidate: Candidate, every: int = 1) -> RenderedError:
        if every == 1 and candidate.pruning_db in overflowing:
            raise SceneFileInvalid("scene", "means", "overflow")
        return measure(ruler, candidate, every)

    few, many = (Target(max_bytes=size, bytes_only=True) for size in (1000, 10**6))
    _, builder, ruler, _ = parts_of(saved(tmp_path, moving_object()), tmp_path, many)
    candidates = [builder.candidate("network", level) for level in (None, 50.0)]
    monkeypatch.setattr(Ruler, "error", error)
    overflowing.add(50.0)
    assert [kept.pruning_db for kept, _ in within_bytes(candidates, ruler, many, refused)] == [None]
    with pytest.raises(TargetNotReached, match="the smallest file tried"):
        within_bytes(candidates, ruler, few, refused)
    assert refused == [("network", "scene: `means` overflow")] * 2
    overflowing.add(None)
    for target in (few, many):
        with pytest.raises(InvalidInput, match=r"one that some plan can hold, got .*overflow"):
            within_bytes(candidates, ruler, target, refused)


def test_a_candidate_that_overflows_at_the_time_of_a_held_out_image_is_refused_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def psnr(pose: Pose, options: RasterizerOptions) -> float:
        pose(0.123)
        return 20.0

    whole = DeformationSession.pose

    def overflowing(session: DeformationSession, t: float, *args: Any, **kwargs: Any) -> Any:
        if t == 0.123 and session.scene.metadata.plan == "network" and not session.scene.static_count:
            raise SceneFileInvalid("scene", "means", "overflow")
        return whole(session, t, *args, **kwargs)

    images = SimpleNamespace(training=(), psnr=psnr)
    parts = parts_of(saved(tmp_path, moving_object()), tmp_path, Target(45.0), images=images)
    monkeypatch.setattr(DeformationSession, "pose", overflowing)
    result = parts.sweep()
    assert ("network", "scene: `means` overflow") in result.refused
    assert ("network", None) not in {(point.candidate.plan, point.candidate.pruning_db) for point in result.points}


@pytest.mark.parametrize("max_mb", [None, 10.0])
@pytest.mark.parametrize("without", [1, 10])
def test_a_plan_is_written_less_pruned_if_a_pruned_one_cannot_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_mb: float | None, without: int
):
    made, levels = CandidateBuilder.candidate, list[float]()

    def candidate(
        builder: CandidateBuilder, plan: str, pruning_db: float | None, sh_degree: int | None = None
    ) -> Candidate:
        if pruning_db is not None:
            levels.append(pruning_db)
            if len(levels) <= without:
                raise InvalidInput("plan", "possible", plan)
        return made(builder, plan, pruning_db, sh_degree)

    monkeypatch.setattr(CandidateBuilder, "candidate", candidate)
    options = ExportOptions(saved(tmp_path, moving_object()), plan="network", min_psnr=45.0, max_mb=max_mb, times=4)
    assert main(options) == 0
    assert len(levels) > 1
    removed = {entry["rule"] for entry in DeformationSession(tmp_path / "model.onnx").scene.metadata.left_out}
    assert bool(removed - {"float32"}) == (without < len(levels))
