"""Steps of a job are kept while nothing that they depend on has changed, and leave nothing if they are stopped."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from msdgs_train.capture.progress import Progress
from msdgs_train.capture.steps import Steps

RESULTS = {"frames": (), "poses": (), "dataset": ("images", "sparse"), "report": ("capture.html",)}


class Job:
    """Writes the settings of each step to its result; `ran` has the steps of the last call that ran."""

    def __init__(self, data: Path) -> None:
        self.data, self.ran, self.kept = data, [], []

    @contextmanager
    def watch(self, name: str, is_kept: bool) -> Iterator[Progress]:
        (self.kept if is_kept else self.ran).append(name)
        yield lambda stage, done, total: None

    def __call__(self, *, start: str = "a", force: str | None = None, stop: str | None = None, **settings: int) -> None:
        self.ran, self.kept = [], []
        steps = Steps(RESULTS, self.data / "capture", start, force=force, watch=self.watch)
        for name, parts in RESULTS.items():

            def run(folder: Path, progress: Progress, name: str = name, parts: tuple[str, ...] = parts) -> None:
                for part in parts or ("result",):
                    (folder / part).mkdir()
                    (folder / part / "value").write_text(f"{settings.get(name)}")
                if name == stop:
                    raise KeyboardInterrupt

            steps.do(name, {"value": settings.get(name)}, run)


@pytest.fixture
def job(tmp_path: Path) -> Job:
    (tmp_path / "kept by its owner").touch()
    return Job(tmp_path)


def test_a_second_run_keeps_all(job: Job):
    job()
    assert job.ran == list(RESULTS)
    job()
    assert (job.ran, job.kept) == ([], list(RESULTS))


@pytest.mark.parametrize(
    ("change", "first"),
    [({"start": "b"}, "frames"), ({"poses": 2}, "poses"), ({"report": 2}, "report"), ({"force": "dataset"}, "dataset")],
)
def test_a_change_repeats_its_step_and_all_that_follow(job: Job, change: dict, first: str):
    names = list(RESULTS)
    job()
    job(**change)
    assert job.ran == names[names.index(first) :]


def test_results_are_moved_beside_the_folder(job: Job):
    job(dataset=3)
    assert (job.data / "images" / "value").read_text() == (job.data / "sparse" / "value").read_text() == "3"
    assert (job.data / "capture.html").exists()


@pytest.mark.parametrize("stop", RESULTS)
def test_ctrl_c_loses_only_the_step_under_way(job: Job, stop: str):
    with pytest.raises(KeyboardInterrupt):
        job(stop=stop)
    names = list(RESULTS)
    assert sorted(path.name for path in (job.data / "capture").iterdir()) == sorted(names[: names.index(stop)])
    job()
    assert job.kept == names[: names.index(stop)]


def test_a_step_that_runs_again_removes_what_followed_from_the_old_one(job: Job):
    job()
    with pytest.raises(KeyboardInterrupt):
        job(poses=2, stop="poses")
    assert sorted(path.name for path in job.data.iterdir()) == ["capture", "kept by its owner"]


def test_a_result_that_was_not_finished_is_made_again(job: Job):
    job()
    (job.data / "capture" / "poses" / "step.json").write_text("{")
    job()
    assert job.ran == ["poses", "dataset", "report"]
