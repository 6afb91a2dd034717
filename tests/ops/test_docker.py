"""Images and composition: static checks, and with a Docker daemon docker/check.py."""

import contextlib
import json
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from uvicorn import Config

from msdgs_serve.api.keys import MIN_KEY_LENGTH
from msdgs_serve.api.settings import Settings
from tests.support.processes import ROOT, free_port
from tests.support.scene_files import write_scene
from tests.support.service import in_this_process, serving

DOCKER = ROOT / "docker"
COMPOSITION = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES, VOLUMES = COMPOSITION["services"], COMPOSITION["volumes"]
(SCRAPED,) = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yaml").read_text())["scrape_configs"]
SKIPPED = 77
METRICS_KEY, READER_KEY = "metrics-0123456789", "reader-0123456789"
PIN = re.compile(r"^([\w.-]+)==([^\s;\\]+)", re.MULTILINE)


def pins(path: Path) -> dict[str, str]:
    return {canonicalize_name(name): version for name, version in PIN.findall(path.read_text())}


@pytest.mark.parametrize("name", ["build", "npm", "serve", "train"])
def test_every_requirement_is_a_tested_version_with_hashes(name: str):
    path = DOCKER / "requirements" / f"{name}.txt"
    tested, locked = pins(ROOT / "constraints.txt"), pins(path)
    assert locked
    differing = {name: version for name, version in locked.items() if tested.get(name) != version}
    assert not differing, "docker/lock.sh renews them"
    blocks = re.split(r"\n(?=\S)", path.read_text().strip())
    assert len(blocks) == len(locked)
    assert all("--hash=sha256:" in block for block in blocks)


@pytest.mark.parametrize(("name", "extras"), [("serve", ("video",)), ("train", ("train", "export"))])
def test_everything_that_the_package_asks_for_is_locked(name: str, extras: tuple[str, ...]):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *(d for extra in extras for d in project["optional-dependencies"][extra])]
    names = {canonicalize_name(Requirement(text).name) for text in asked}
    assert names - pins(DOCKER / "requirements" / f"{name}.txt").keys() <= {"torch"}, "docker/lock.sh renews them"


def test_the_serve_image_has_no_torch_and_renders_videos():
    assert not {"torch", "onnx", "scipy", "matplotlib"} & pins(DOCKER / "requirements" / "serve.txt").keys()
    assert "av" in pins(DOCKER / "requirements" / "serve.txt")
    assert "torch" not in pins(DOCKER / "requirements" / "train.txt"), "it comes from another index"


def test_copied_files_are_in_the_build_context():
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = re.findall(
        r"^COPY (?!--from)(?:--chown=\S+ )?(.+) \S+$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE
    )
    files = [file for line in copied for file in line.split()]
    assert files
    for file in files:
        assert (ROOT / file).exists()
        parts = [Path(file), *Path(file).parents]
        assert any(part.match(pattern) for pattern in sent for part in parts[:-1]), file


def test_services_have_limits_and_no_rights_they_don_t_need():
    for name, service in SERVICES.items():
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], f"{name}: and Docker's own seccomp profile"
        assert service["read_only"], name
        assert service["user"].split(":")[0] not in ("0", "root"), name
        assert not {"privileged", "cap_add", "devices", "pid", "network_mode", "userns_mode"} & service.keys(), name
        assert service["mem_limit"] == service["memswap_limit"], name
        assert 0 < service["pids_limit"] <= 512, name


def test_nothing_can_be_run_from_where_a_service_may_write():
    for name, service in SERVICES.items():
        assert all("noexec" in each for each in service.get("tmpfs", ())), name
        writable = [each.split(":")[0] for each in service.get("volumes", ()) if not each.endswith(":ro")]
        assert writable == {"render": ["uploads"], "prometheus": ["measurements"]}.get(name, [])
    assert VOLUMES["uploads"]["driver_opts"]["o"].startswith("noexec,nosuid,nodev")


def test_prometheus_has_a_key_where_keys_are_asked_for():
    (secret,) = SERVICES["prometheus"]["secrets"]
    assert SCRAPED["authorization"]["credentials_file"] == f"/run/secrets/{secret}"
    default = re.search(r":-(\S+)}", COMPOSITION["secrets"][secret]["file"])
    assert default
    assert len((DOCKER / default[1]).read_text().strip()) < MIN_KEY_LENGTH, "the default must not be a valid key"


def test_the_service_trusts_the_address_from_the_proxy():
    assert "proxy_set_header X-Forwarded-For $remote_addr;" in (DOCKER / "nginx" / "nginx.conf").read_text()
    render = SERVICES["render"]
    assert render["environment"]["MSDGS_PROXIES"] == "*"
    assert "ports" not in render, "every client would be trusted"


def test_the_proxys_limits_follow_those_of_the_service():
    settings, limits = (DOCKER / "nginx" / "nginx.conf").read_text(), Settings.model_fields
    (seconds,) = map(float, re.findall(r"^    proxy_read_timeout (\d+)s;", settings, re.MULTILINE))
    assert limits["render_seconds"].default < seconds < 2 * limits["render_seconds"].default
    assert f"client_max_body_size {limits['max_body_bytes'].default >> 20}m;" in settings
    (idle,) = {float(each) for each in re.findall(r"keepalive_timeout (\d+)s;", settings)}
    service = Config("", log_config=None)  # the default would set up logging for all tests
    assert idle < service.timeout_keep_alive, "nginx closes idle connections, not the service during a request"
    assert seconds_of(SERVICES["proxy"]["stop_grace_period"]) > seconds
    assert seconds_of(SERVICES["render"]["stop_grace_period"]) > limits["drain_seconds"].default


def test_the_build_gets_its_arguments_certificates_and_network():
    build = SERVICES["render"]["build"]
    stated = set(re.findall(r"^ARG (\w+)=", (DOCKER / "Dockerfile").read_text(), re.MULTILINE))
    assert build["args"].keys() == stated
    mounted = set(re.findall(r"--mount=type=secret,id=(\w+)", (DOCKER / "Dockerfile").read_text()))
    assert set(build["secrets"]) == mounted
    assert COMPOSITION["secrets"]["ca"]["file"] == "${CA_FILE:-/dev/null}", "optional"
    assert build["network"] == "${BUILD_NETWORK:-default}", "optional"


def seconds_of(duration: str) -> float:
    return float(duration.removesuffix("s"))


def test_all_settings_of_the_service_exist():
    known = {f"MSDGS_{name.upper()}" for name in Settings.model_fields}
    assert SERVICES["render"]["environment"].keys() <= known
    in_image = re.findall(r"MSDGS_\w+", (DOCKER / "Dockerfile").read_text())
    assert in_image
    assert set(in_image) <= known


def queries_of_the_dashboard() -> list[str]:
    dashboard = json.loads((DOCKER / "grafana" / "dashboards" / "msdgs.json").read_text())
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


@pytest.mark.slow
@in_this_process
@pytest.mark.skipif(shutil.which("prometheus") is None, reason="there is no prometheus to run")
def test_prometheus_answers_every_query_of_the_dashboard(tmp_path: Path):
    scene = write_scene(tmp_path / "balls.onnx")
    (tmp_path / "keys").write_text(f"operate {METRICS_KEY}\nread {READER_KEY}")
    with (
        serving(scene, api_keys_file=tmp_path / "keys") as client,
        prometheus(tmp_path, client.base_url.netloc.decode()) as answer,
    ):
        unanswered = queries_of_the_dashboard()
        assert unanswered
        deadline = time.monotonic() + 60
        while unanswered and time.monotonic() < deadline:
            for camera, status in (({"type": "orbit", "azimuth": 0, "elevation": 0}, 200), (None, 422)):
                body = {"camera": camera, "t": 0.5, "width": 16, "height": 16}
                assert client.post("/render", json=body, headers={"X-API-Key": READER_KEY}).status_code == status
            time.sleep(0.2)
            unanswered = [query for query in unanswered if not answer(query)]
        assert not unanswered


@contextlib.contextmanager
def prometheus(folder: Path, target: str) -> Iterator[Callable[[str], list[Any]]]:
    """Run Prometheus with the composition's settings, scraping `target` every second; yields a query function."""
    settings = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yaml").read_text())
    settings["global"]["scrape_interval"] = "1s"
    (job,) = settings["scrape_configs"]
    del job["dns_sd_configs"]
    key = folder / "metrics.key"
    key.write_text(METRICS_KEY)
    job["authorization"]["credentials_file"] = str(key)
    job["static_configs"] = [{"targets": [target]}]
    (folder / "prometheus.yaml").write_text(yaml.safe_dump(settings))
    address = f"127.0.0.1:{free_port()}"
    options = [f"--config.file={folder}/prometheus.yaml", f"--storage.tsdb.path={folder}/data"]
    command = ["prometheus", *options, f"--web.listen-address={address}"]

    def answer(query: str) -> list[Any]:
        with contextlib.suppress(httpx.TransportError):  # not listening yet
            found = httpx.get(f"http://{address}/api/v1/query", params={"query": query})
            return found.json()["data"]["result"] if found.status_code == 200 else []
        return []

    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            yield answer
        finally:
            process.terminate()


@pytest.mark.slow
def test_the_image_and_the_composition_with_a_daemon():
    done = subprocess.run(
        [sys.executable, DOCKER / "check.py"], cwd=ROOT, capture_output=True, text=True, timeout=1800, check=False
    )
    if done.returncode == SKIPPED:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stdout + done.stderr
