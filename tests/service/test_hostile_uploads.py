"""Hostile scene files at a running service are refused or listed as broken, and another scene is still served."""

import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import onnx
import pytest
from onnx import helper, numpy_helper

from msdgs_serve.api.settings import Settings
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx import GraphLimits
from msdgs_serve.trial import try_scene
from tests.support.fuzz_scenes import hostile_file
from tests.support.fuzzing import CASES, SEED
from tests.support.hostile_scenes import ATTACKS, POISON, Attack, poisoned
from tests.support.processes import run_python
from tests.support.scene_files import write_scene
from tests.support.service import FRAME, check_problem, eventually, in_this_process, serving
from tests.support.sound_scenes import sound_scenes

MUTATED = 2 * CASES // 5
"""Each is opened in a process of its own."""


def frame(client: httpx.Client) -> bytes:
    response = client.post("/render", json={**FRAME, "scene": "good"})
    assert response.status_code == 200, response.text
    return response.content


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / "good.onnx")
    with serving(folder, uploads=True) as client:
        yield client


@pytest.mark.parametrize("attack", ATTACKS, ids=str)
def test_attacks_are_refused_while_another_scene_is_served(
    client: httpx.Client, tmp_path: Path, file: bytes, attack: Attack
):
    (tmp_path / "secret").write_bytes(b"s" * 24)
    contents = attack.on(onnx.load_from_string(file), tmp_path / "secret")
    before = frame(client)
    answers: list[httpx.Response] = []

    def upload() -> None:
        answers.append(client.post("/scenes", params={"name": "hostile"}, content=contents))

    thread = threading.Thread(target=upload)
    thread.start()
    assert frame(client) == before
    thread.join()
    check_problem(answers[0], 422)
    assert attack.message in answers[0].json()["detail"]
    assert str(tmp_path) not in answers[0].text
    assert [scene["name"] for scene in client.get("/scenes").json()["scenes"]] == ["good"]
    assert frame(client) == before


def test_the_cost_of_a_scene_is_shown(client: httpx.Client):
    cost = client.get("/scenes/good").json()["cost"]
    assert 0 < cost["memory_bytes"] < cost["limits"]["memory_bytes"] == 2 << 30
    assert 0 < cost["operations"] < cost["limits"]["operations"] == 1e13
    assert cost["calls"] == 1


def test_limits_are_settings(tmp_path: Path):
    write_scene(tmp_path / "good.onnx")
    with serving(tmp_path, max_scene_operations=1) as client:
        entry = client.get("/scenes").json()["scenes"][0]
        assert (entry["problem"], entry["loaded"]) == (True, False)
        assert entry["reason"].endswith("the limit is 1")


def test_poisoned_files_are_listed_as_broken_and_nothing_else_changes(tmp_path: Path):
    good = write_scene(tmp_path / "good.onnx")
    poison = {f"bad {number}": what for number, what in enumerate(POISON)}
    contents = {name: poisoned(onnx.load(good), what) for name, what in poison.items()}
    for name in poison:
        (tmp_path / f"{name}.onnx").write_bytes(contents[name])
    with serving(tmp_path) as client:
        before = frame(client)
        listed = {scene.pop("name"): scene for scene in client.get("/scenes").json()["scenes"]}
        assert listed.pop("good") == {"loaded": True, "problem": False, "reason": None}
        assert listed.keys() == poison.keys()
        for name, what in poison.items():
            assert client.post("/render", json={**FRAME, "scene": name}).status_code == 503, what
            bad = listed[name]
            assert (bad["problem"], bad["loaded"]) == (True, False), what
            assert POISON[what][0] in bad["reason"]
            assert bad["reason"].isprintable(), what
            (tmp_path / f"{name}.onnx").touch()  # it is reloaded
        write_scene(good, static_color=(0, 0, 1))
        eventually(lambda: frame(client) != before)


@pytest.mark.xdist_group("sound scenes")  # one worker makes them
def test_mutated_files_are_refused_or_served_without_a_server_error(folder: Path):
    write_scene(folder / "good.onnx")
    scenes = sound_scenes()
    with serving(folder, uploads=True) as client:
        before = frame(client)
        for seed in range(SEED, SEED + MUTATED):
            query = {"name": "mutated", "replace": "true"}
            answer = client.post("/scenes", params=query, content=hostile_file(scenes, seed))
            assert answer.status_code in (201, 422), (seed, answer.text)
            for t in (0, 0.37, 1) if answer.status_code == 201 else ():
                drawn = client.post("/render", json={**FRAME, "scene": "mutated", "t": t})
                assert drawn.status_code in (200, 422, 503), (seed, drawn.text)
        assert frame(client) == before


def test_a_scene_that_overflows_at_its_start_alone_is_refused_and_stops_no_service(tmp_path: Path):
    """Of the 65 moving Gaussians it is the last, which loading doesn't pose."""
    model = onnx.load(write_scene(tmp_path / "bad.onnx", moving=65))
    constants = {each.name: each for each in model.graph.initializer}
    for name, value in (("base", 3e38), ("velocity", 5e37)):
        array = numpy_helper.to_array(constants[name]).copy()
        array[-1] = value
        constants[name].CopyFrom(numpy_helper.from_array(array, name))
    (place,) = (number for number, node in enumerate(model.graph.node) if node.output[0] == "applied")
    model.graph.node[place].CopyFrom(helper.make_node("Sub", ["one", "t"], ["applied"]))
    onnx.save(model, tmp_path / "bad.onnx")
    with pytest.raises(SceneFileInvalid, match=r"infinite for 1 Gaussians at t = 0\.0"):
        try_scene(tmp_path / "bad.onnx", GraphLimits(), 60)
    write_scene(tmp_path / "good.onnx")
    with serving(tmp_path) as client:
        assert frame(client)
        for t, status in ((0, 503), (0.5, 200)):
            assert client.post("/render", json={**FRAME, "scene": "bad", "t": t}).status_code == status


def test_a_file_that_takes_too_long_is_refused(tmp_path: Path):
    path = write_scene(tmp_path / "scene.onnx")
    try_scene(path, GraphLimits(), 60)
    with pytest.raises(SceneFileInvalid, match=r"isn't read within 0.01 s"):
        try_scene(path, GraphLimits(), 0.01)


@in_this_process
@pytest.mark.skipif(sys.platform != "linux", reason="other systems don't enforce a memory limit")
def test_a_file_that_ends_its_process_is_refused_at_upload(folder: Path, file: bytes, monkeypatch: pytest.MonkeyPatch):
    dying = GraphLimits(memory_bytes=-(1 << 29))  # leaves no memory to the subprocess
    with serving(folder, uploads=True) as client:
        monkeypatch.setattr(Settings, "graph_limits", dying)
        answer = client.post("/scenes", params={"name": "walk"}, content=file)
        assert (answer.status_code, list(folder.iterdir())) == (422, [])
        assert "crashes the process that reads it" in answer.json()["detail"]
        monkeypatch.undo()
        assert client.post("/scenes", params={"name": "walk"}, content=file).status_code == 201


SERVICE = """
import sys
from pathlib import Path
from tests.support.service import serving
folder, contents, frame = Path(sys.argv[1]), Path(sys.argv[2]).read_bytes(), %r
with serving(folder, uploads=True) as client:
    assert client.post("/scenes", params={"name": "walk"}, content=contents).status_code == 201
    assert client.post("/render", json=frame).status_code == 200
"""


PLACES = ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR")
"""Variables that name folders in which programs store files."""


def test_a_service_writes_no_file_besides_its_scenes(tmp_path: Path, folder: Path, scene: Path):
    """By default onnxruntime keeps a database of telemetry in the home folder."""
    home = tmp_path / "home"
    home.mkdir()
    run_python(SERVICE % FRAME, folder, scene, PYTHONDONTWRITEBYTECODE="1", **dict.fromkeys(PLACES, str(home)))
    assert list(home.rglob("*")) == []
    assert [path.name for path in folder.rglob("*")] == ["walk.onnx"]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"checkpoint_sha256": "1" * 64},
        {"points": [{"plan": "prefix:1", "error": {"psnr_worst": 50.0}, "chosen": True}]},
        {"points": [{"plan": "network", "error": {"psnr_worst": 51.0}, "chosen": True}]},
        {"points": [{"plan": "network", "error": {"psnr_worst": 50.0}, "chosen": False}]},
        {"points": "network"},
    ],
)
def test_a_report_of_another_file_is_not_that_of_the_scene(tmp_path: Path, changes: dict[str, Any]):
    error = {"psnr_worst": 50.0}
    write_scene(tmp_path / "good.onnx", measured_error={"rendered": error})
    points = [{"plan": "network", "error": error, "chosen": True}]
    report: dict[str, Any] = {"format": "msdgs-report/1", "checkpoint_sha256": "0" * 64, "points": points}
    (tmp_path / "good.report.json").write_text(json.dumps(report | changes))
    with serving(tmp_path) as client:
        assert client.get("/scenes/good").json()["report"] == (not changes)
        assert client.get("/scenes/good/report").status_code == (404 if changes else 200)


@pytest.mark.parametrize("milliseconds", [f"1{'0' * 400}", "1e999", "[" * 100_000 + "]" * 100_000])
def test_a_poisoned_report_beside_a_scene_is_refused(tmp_path: Path, milliseconds: str):
    write_scene(tmp_path / "good.onnx")
    point = {"plan": "network", "error": {"psnr_worst": 50.0}, "milliseconds": {"total": {"min": "MILLISECONDS"}}}
    report = {"format": "msdgs-report/1", "checkpoint_sha256": "0" * 64, "points": [point]}
    text = json.dumps(report).replace('"MILLISECONDS"', milliseconds)
    (tmp_path / "good.report.json").write_text(text)
    with serving(tmp_path) as client:
        assert client.get("/scenes/good/report").status_code == 503
