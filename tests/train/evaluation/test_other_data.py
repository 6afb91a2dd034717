"""An evaluation on other data than those of the run says so."""

import json
import shutil
from pathlib import Path

import pytest

from msdgs_train.engine.run import fit
from msdgs_train.evaluation import report
from msdgs_train.evaluation.evaluate import evaluate_run
from tests.support.training_scene import small_config

pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("no_curve")
def test_data_that_the_run_was_not_trained_on_is_named(data: Path, tmp_path: Path) -> None:
    run, copy = tmp_path / "run", tmp_path / "copy"
    fit(small_config(steps=1), data, run)
    shutil.copytree(data, copy)
    assert evaluate_run(run, copy, brief=True).differing == []
    file = copy / "transforms_train.json"
    content = json.loads(file.read_text())
    content["frames"][0]["transform_matrix"][0][3] += 100
    file.write_text(json.dumps(content))
    evaluation = evaluate_run(run, copy, brief=True)
    assert f"data: not as in training; {copy} differs in cameras." in report.notes(evaluation)
