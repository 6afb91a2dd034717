"""Candidates that can't be made or drawn: they are refused alone, and others are chosen."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from export.jobs.job import ESTIMATE_STRIDE, Candidate, ExportJob
from export.jobs.store import within_bytes
from export.jobs.sweep import Sweep
from export.measure.poses import Pose
from export.measure.rendered_error import RenderedError
from export.options import ExportOptions
from export.plans.registry import PLANS
from export.target import TargetNotReached
from export.to_onnx import main
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from tests.support.models import moving_object, saved

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_candidates")]


@pytest.mark.parametrize("at", ["all times", "one that no estimate tries"])
def test_plans_whose_motion_overflows_in_float32_are_refused_and_fitted_ones_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
):
    job = ExportJob(saved(tmp_path, moving_object()), tmp_path, min_psnr=45.0)
    whole = DeformationSession.pose
    views = job.exact.views
    one = ({view.t for view in views} - {view.t for view in views[::ESTIMATE_STRIDE]}).pop()

    def pose(session: DeformationSession, t: float, *args: Any, **kwargs: Any) -> Any:
        if not session.scene.metadata.plan.startswith("compact") and (at == "all times" or t == one):
            raise SceneFileInvalid("scene", "means", "overflow")
        return whole(session, t, *args, **kwargs)

    monkeypatch.setattr(DeformationSession, "pose", pose)
    monkeypatch.setitem(PLANS, "compact", replace(PLANS["compact"], candidates=lambda layers: ["compact:70"]))
    result = Sweep(job).run()
    assert {plan for plan, why in result.refused if "overflow" in why} == {"network", "prefix:1"}
    assert {point.candidate.plan for point in result.points} == {"compact:70"}


def test_a_file_of_few_bytes_that_overflows_is_refused_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    measure, overflowing, refused = ExportJob.error, set[float | None](), list[tuple[str, str]]()

    def error(job: ExportJob, candidate: Candidate, every: int = 1) -> RenderedError:
        if every == 1 and candidate.pruning_db in overflowing:
            raise SceneFileInvalid("scene", "means", "overflow")
        return measure(job, candidate, every)

    job = ExportJob(saved(tmp_path, moving_object()), tmp_path, max_bytes=10**6)
    candidates = [job.candidate("network", level) for level in (None, 50.0)]
    monkeypatch.setattr(ExportJob, "error", error)
    overflowing.add(50.0)
    assert [kept.pruning_db for kept, _ in within_bytes(job, candidates, refused)] == [None]
    job.max_bytes = 1000
    with pytest.raises(TargetNotReached, match="the smallest file tried"):
        within_bytes(job, candidates, refused)
    assert refused == [("network", "scene: `means` overflow")] * 2
    overflowing.add(None)
    for job.max_bytes in (1000, 10**6):
        with pytest.raises(InvalidInput, match=r"one that some plan can hold, got .*overflow"):
            within_bytes(job, candidates, refused)


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

    job = ExportJob(saved(tmp_path, moving_object()), tmp_path, min_psnr=45.0)
    job.images = cast(Any, SimpleNamespace(training=(), psnr=psnr))
    monkeypatch.setattr(DeformationSession, "pose", overflowing)
    result = Sweep(job).run()
    assert ("network", "scene: `means` overflow") in result.refused
    assert ("network", None) not in {(point.candidate.plan, point.candidate.pruning_db) for point in result.points}


@pytest.mark.parametrize("max_mb", [None, 10.0])
@pytest.mark.parametrize("without", [1, 10])
def test_a_plan_is_written_less_pruned_if_a_pruned_one_cannot_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_mb: float | None, without: int
):
    made, levels = ExportJob.candidate, list[float]()

    def candidate(job: ExportJob, plan: str, pruning_db: float | None, sh_degree: int | None = None) -> Candidate:
        if pruning_db is not None:
            levels.append(pruning_db)
            if len(levels) <= without:
                raise InvalidInput("plan", "possible", plan)
        return made(job, plan, pruning_db, sh_degree)

    monkeypatch.setattr(ExportJob, "candidate", candidate)
    options = ExportOptions(saved(tmp_path, moving_object()), plan="network", min_psnr=45.0, max_mb=max_mb, times=4)
    assert main(options) == 0
    assert len(levels) > 1
    removed = {entry["rule"] for entry in DeformationSession(tmp_path / "model.onnx").scene.metadata.left_out}
    assert bool(removed - {"float32"}) == (without < len(levels))
