"""Times in `times.json` beside a dataset whose own files have none."""

import json
from pathlib import Path
from typing import Any

import pytest

from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.times_file import TIMES_FILE, write_times
from tests.train.datasets.layouts import nerfstudio_json, write_nerfstudio

NAMES = [f"images/f_{index:02}.png" for index in range(3)]
TIMES = dict(zip(NAMES, [0.5, 0.0, 0.75], strict=True))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_times(tmp_path, TIMES)
    return write_nerfstudio(tmp_path, content=nerfstudio_json(3))


def times_of(folder: Path, **options: Any) -> list[float]:
    scene = load_scene(folder, **options)
    return [frame.t for frame in scene.splits["test"] + scene.splits["train"]]


def test_a_nerfstudio_scene_without_times_has_those_of_the_file(folder: Path):
    assert times_of(folder) == list(TIMES.values())
    assert times_of(folder, time_from="index") == [0.0, 0.5, 1.0]
    assert times_of(folder, time_from="none") == [0.0, 0.0, 0.0]
    (folder / TIMES_FILE).unlink()
    assert times_of(folder) == [0.0, 0.0, 0.0]


def test_its_own_times_come_first(folder: Path):
    content = nerfstudio_json(3)
    for index, frame in enumerate(content["frames"]):
        frame["time"] = 0.25 * index
    assert times_of(write_nerfstudio(folder, content=content)) == [0.0, 0.25, 0.5]


@pytest.mark.parametrize(
    "name", ["./images/f_01.png", "images\\f_01.png", "Images/F_01.PNG", "images/../images/f_01.png"]
)
def test_names_may_be_spelled_as_on_other_systems(folder: Path, name: str):
    write_times(folder, {NAMES[0]: 0.5, name: 0.25, NAMES[2]: 0.75})
    assert times_of(folder) == [0.5, 0.25, 0.75]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"unit": "seconds", "times": {NAMES[0]: 0.0, NAMES[2]: 0.5}}, r"`times\.images/f_01\.png` is missing"),
        (
            {"unit": "seconds", "times": {**TIMES, NAMES[1]: "0.5"}},
            r"`times\.images/f_01\.png` must be a finite number",
        ),
        ({"unit": "frames", "times": TIMES}, "`unit` must be seconds, got 'frames'"),
        ({"unit": "seconds"}, "`times` is missing"),
        ([0.0, 0.5], "`file` must hold a JSON object"),
    ],
)
def test_a_file_that_gives_no_times_is_refused(folder: Path, content: Any, problem: str):
    (folder / TIMES_FILE).write_text(json.dumps(content))
    with pytest.raises(DatasetInvalid, match=rf"{TIMES_FILE}: {problem}"):
        load_scene(folder)
