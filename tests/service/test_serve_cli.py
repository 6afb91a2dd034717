"""The command `msdgs-serve`: its output, its first frame, its exit status."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from msdgs_serve.api.arguments import GROUPS, read_settings
from msdgs_serve.api.cli import addresses, main
from msdgs_serve.api.settings import Settings
from msdgs_serve.threads import THREADS_VARIABLE, thread_count
from tests.support.images import decode
from tests.support.scene_files import write_scene
from tests.support.service import MAX_SECONDS

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-c", "import sys; from msdgs_serve.api.cli import main; sys.exit(main())"]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "balls.onnx")


@pytest.fixture
def process(scene: Path) -> Iterator[subprocess.Popen[str]]:
    command = [*COMMAND, str(scene), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def read_until(process: subprocess.Popen[str], pattern: str) -> str:
    assert process.stdout
    printed = ""
    for line in process.stdout:
        printed += line
        if re.search(pattern, line):
            return printed
    assert process.stderr
    raise AssertionError(f"it ended: {printed}{process.stderr.read()}")


@pytest.mark.parametrize("signals", [[signal.SIGINT], [signal.SIGINT, signal.SIGTERM]])
def test_it_prints_its_address_and_an_example_and_stops_at_ctrl_c(process: subprocess.Popen[str], signals: list[int]):
    printed = read_until(process, r"-d '")
    match = re.search(r"Listening on (http://127\.0\.0\.1:\d+)", printed)
    assert match
    assert httpx.get(f"{match[1]}/ready", timeout=MAX_SECONDS).status_code == 200
    words = shlex.split(printed[printed.index("curl") :])
    body, headers = words[words.index("-d") + 1], dict([words[words.index("-H") + 1].split(": ")])
    response = httpx.post(words[1], content=body, headers=headers, timeout=MAX_SECONDS)
    assert response.status_code == 200, response.text
    assert decode(response.content, "png")[0].shape == (400, 400, 3)
    for number in (signal.SIGSTOP, *signals, signal.SIGCONT):  # stopped, it receives all of them before it can end
        process.send_signal(number)
    out, err = process.communicate(timeout=600)
    assert (process.returncode, out.strip(), err) == (0, "Stopped.", "")


@pytest.mark.parametrize(
    ("host", "listening", "local"),
    [
        ("127.0.0.1", "http://127.0.0.1:80", "http://127.0.0.1:80"),
        ("192.168.0.7", "http://192.168.0.7:80", "http://192.168.0.7:80"),
        ("0.0.0.0", "http://0.0.0.0:80", "http://127.0.0.1:80"),
        ("::", "http://[::]:80", "http://[::1]:80"),
        ("fe80::1", "http://[fe80::1]:80", "http://[fe80::1]:80"),
    ],
)
def test_the_address_that_it_listens_on_isnt_the_one_to_call(host: str, listening: str, local: str):
    assert addresses(host, 80) == (listening, local)


def test_in_a_container_it_prints_that_it_listens_everywhere(scene: Path):
    environment = {**os.environ, "MSDGS_HOST": "0.0.0.0"}
    with subprocess.Popen(
        [*COMMAND, str(scene), "--port", "0"], stdout=subprocess.PIPE, env=environment, text=True
    ) as process:
        try:
            printed = read_until(process, r"curl")
        finally:
            process.kill()
    match = re.search(r"Listening on http://0\.0\.0\.0:(\d+), all addresses of this machine or container", printed)
    assert match
    assert f"http://127.0.0.1:{match[1]}/docs" in printed
    assert f"curl http://127.0.0.1:{match[1]}/render" in printed


def test_help_shows_examples_and_each_option_in_its_group(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    for part in ("msdgs-serve scene.onnx", "MSDGS_SCENES=", "msdgs-export", "/docs"):
        assert part in text
    parts = dict(re.findall(r"^(\S.*):\n((?:  .*\n)+)", text, re.MULTILINE))
    groups = {title: re.findall(r"^  --([\w-]+)", part, re.MULTILINE) for title, part in parts.items()}
    assert {name: title for title, names in groups.items() for name in names} == {
        name.replace("_", "-"): title for title, settings in GROUPS.items() for name in settings.model_fields
    }
    assert sum(map(len, groups.values())) == len(Settings.model_fields) - 1, "scenes are no option"
    for default in ("null", "factory", "None", "default: )", "[]"):
        assert default not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no scene given"),
        (["missing.onnx"], "missing.onnx, which does not exist"),
        (["model.pt"], "msdgs-export"),
        (["broken.onnx", "--port", "0"], "broken.onnx: `file`"),
        (["balls.onnx", "--port", "70000"], "--port: "),
        (["balls.onnx", "--max-pixels", "many"], "--max-pixels: "),
        (["balls.onnx", "--host", "256.1.1.1"], "can't listen on 256.1.1.1"),
        (["balls.onnx", "--host", "256.1.1.1", "--uploads"], "`uploads` must be given with a folder"),
    ],
)
def test_errors_are_one_line(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
):
    monkeypatch.chdir(scene.parent)
    Path("model.pt").touch()
    Path("broken.onnx").write_bytes(scene.read_bytes()[:50])
    assert main(arguments) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("msdgs-serve: ")
    assert message in complaint
    assert complaint.count("\n") == 1


def test_wrong_threads_in_the_environment_are_named(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv(THREADS_VARIABLE, "abc")
    assert main([str(scene)]) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("msdgs-serve: --threads or MSDGS_THREADS: ")
    assert complaint.count("--") == complaint.count("\n") == 1


def test_threads_limit_concurrent_renders(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "3")
    assert Settings().concurrent_renders == 3
    assert Settings(threads=1).concurrent_renders == 1
    assert Settings(threads=1, concurrent_renders=2).concurrent_renders == 2


def test_a_start_that_fails_ends_the_program(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(*_: object) -> bytes:
        raise RuntimeError("no memory")

    monkeypatch.setattr("msdgs_serve.api.service.encode", fail)
    assert main([str(scene), "--port", "0"]) == 2
    assert "could not start" in capsys.readouterr().err


def test_a_port_in_use_is_reported_before_anything_is_loaded(scene: Path, capsys: pytest.CaptureFixture[str]):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main([str(scene), "--port", str(port)]) == 2
    printed = capsys.readouterr()
    assert f"can't listen on 127.0.0.1 port {port}" in printed.err
    assert "Loading" not in printed.out


def test_flags_win_over_the_environment(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MSDGS_SCENES", f"{scene}:{tmp_path}")
    monkeypatch.setenv("MSDGS_PORT", "9000")
    monkeypatch.setenv("MSDGS_MAX_PIXELS", "500")
    settings = read_settings(["--port", "9001"])
    assert settings.scenes == [scene, tmp_path]
    assert (settings.port, settings.max_pixels) == (9001, 500)
    settings = read_settings(["other.onnx"])
    assert settings.scenes == [Path("other.onnx")]


@pytest.mark.parametrize(
    ("variable", "meant"),
    [
        ("MSDGS_API_KEY_FILE", "MSDGS_API_KEYS_FILE"),
        ("MSDGS_MAX_PIXEL", "MSDGS_MAX_PIXELS"),
        ("msdgs_scene", "MSDGS_SCENES"),
        ("MSDGS_API_KEYS", "MSDGS_API_KEYS_FILE"),
        ("MSDGS_APIKEY", "MSDGS_API_KEYS_FILE"),
    ],
)
def test_a_misspelled_variable_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], variable: str, meant: str
):
    monkeypatch.setenv(variable, "keys")
    assert main([]) == 2
    assert f"`{variable}` must be called {meant}" in capsys.readouterr().err


def test_other_variables_are_those_of_other_programs(monkeypatch: pytest.MonkeyPatch):
    for name in ("MSDGS_IMAGE", "MSDGS_SERVICE_HOST", "MSDGS_PORT_8000_TCP", "MSDGS_PLUGINS", "MSDGS_VERSION"):
        monkeypatch.setenv(name, "any")
    assert read_settings([]).port == 8000


def test_an_empty_variable_is_none(scene: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "")
    assert thread_count() >= 1
    assert read_settings([str(scene)]).threads is None


@pytest.mark.parametrize("origins", ["a.org", '["https://a.org"]', "https://a.org/page", "https://"])
def test_what_is_no_origin_is_named(capsys: pytest.CaptureFixture[str], origins: str):
    assert main(["--cors-origins", origins]) == 2
    assert "--cors-origins: must be origins such as https://example.org" in capsys.readouterr().err


def test_origins_may_have_blanks_around_and_a_slash_at_the_end():
    given = "https://a.org, http://localhost:3000/ ,*"
    assert read_settings(["--cors-origins", given]).cors_origins == ["https://a.org", "http://localhost:3000", "*"]


def test_a_list_is_joined_by_commas_or_given_again():
    settings = read_settings(["--cors-origins", "https://a.org,https://b.org", "--cors-origins", "https://c.org"])
    assert settings.cors_origins == ["https://a.org", "https://b.org", "https://c.org"]


@pytest.mark.parametrize(("flags", "uploads"), [([], True), (["--no-uploads"], False), (["--uploads"], True)])
def test_a_switch_wins_over_the_environment(monkeypatch: pytest.MonkeyPatch, flags: list[str], uploads: bool):
    monkeypatch.setenv("MSDGS_UPLOADS", "true")
    assert read_settings(flags).uploads is uploads


def test_any_path_is_one_scene():
    paths = [Path(name) for name in ("a,b.onnx", "[x].onnx", "{y", 'it"s.onnx', "it's.onnx", "3", " c\\", "null")]
    settings = read_settings([str(path) for path in paths])
    assert settings.scenes == paths
