"""Check the image and the composition: build, run with few rights, kill a replica under load.

    python docker/check.py                                    with images from the default registry
    BASE_IMAGE=… PROXY_IMAGE=… python docker/check.py         with other images, such as local ones

Environment variables: BASE_IMAGE, PIP_INDEX_URL, MSDGS_IMAGE, PROXY_IMAGE as in compose.yaml; CA_FILE, certificates for
the build; BUILD_NETWORK, `host` if containers have no other; DOCKER, the command.
Without a daemon it prints the reason and the exit status is 77. Containers, network and volumes are removed at the end.
"""

import itertools
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from email.message import Message
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # to import `tests`
SKIPPED = 77
DOCKER = os.environ.get("DOCKER", "docker")
IMAGE = os.environ.get("MSDGS_IMAGE", "msdgs:check")
BASE_IMAGE = os.environ.get("BASE_IMAGE", "python:3.11-slim-bookworm")
PROXY_IMAGE = os.environ.get("PROXY_IMAGE", "nginx:1.28-alpine")
PROJECT = "msdgs-check"
REPLICAS = 3
LOAD = 120
"""Frames that are requested while a replica is killed."""
CLIENTS = 4
KEYS = {"read": "reader-0123456789", "write": "writer-0123456789"}
CAN_READ, CAN_WRITE = ({"X-API-Key": KEYS[scope]} for scope in ("read", "write"))
MAX_MEGABYTES = 600
MAX_MEMORY = 1e9
"""Maximum memory of a replica in bytes, hostile uploads included."""
MAX_START_SECONDS = 120.0
"""Maximum seconds until a service is ready, also on a busy machine."""
HARDENED = [
    "--read-only", "--tmpfs", "/tmp:noexec,nosuid,nodev,size=256m", "--cap-drop", "ALL",
    "--security-opt", "no-new-privileges", "--memory", "4g", "--memory-swap", "4g", "--pids-limit", "512",
]  # fmt: skip


class Skipped(Exception):
    """Nothing can be checked here."""


class Response(NamedTuple):
    """The response to an HTTP request."""

    status: int
    headers: Message  # names in any case
    body: bytes


def main() -> int:
    """Run all checks; the first failure ends the program."""
    try:
        available()
    except Skipped as reason:
        print(f"skipped: {reason}")
        return SKIPPED
    build()
    check_contents()
    check_cold_start()
    with composition(REPLICAS) as url:
        check_cache(url)
        check_affinity(url)
        check_kill(url)
    with tempfile.NamedTemporaryFile("w") as keys:
        keys.write("".join(f"{scope} {key}\n" for scope, key in KEYS.items()))
        keys.flush()
        os.chmod(keys.name, 0o644)  # for user 10001
        with composition(1, MSDGS_UPLOADS="true", API_KEYS=keys.name) as url:
            check_uploads(url)
            check_hostile_uploads(url)
    print("The image and the composition do what docs/docker.md says.")
    return 0


def available() -> None:
    """Raise `Skipped` without a Docker daemon, compose or base images."""
    if shutil.which(DOCKER) is None:
        raise Skipped(f"there is no {DOCKER} command")
    if output(DOCKER, "info", check=False).returncode != 0:
        raise Skipped("no Docker daemon answers")
    if output(DOCKER, "compose", "version", check=False).returncode != 0:
        raise Skipped("there is no docker compose; docker-compose 1 can't read compose.yaml")
    for image in (BASE_IMAGE, PROXY_IMAGE):
        known = output(DOCKER, "image", "inspect", image, check=False).returncode == 0
        if not known and output(DOCKER, "pull", "--quiet", image, check=False).returncode != 0:
            raise Skipped(f"image {image} is not available")


def build() -> None:
    """Build the target `serve`."""
    command = [DOCKER, "build", "-f", "docker/Dockerfile", "--target", "serve", "-t", IMAGE]
    command += ["--build-arg", f"BASE_IMAGE={BASE_IMAGE}"]
    given = {
        "PIP_INDEX_URL": "--build-arg=PIP_INDEX_URL",
        "CA_FILE": "--secret=id=ca,src",
        "BUILD_NETWORK": "--network",
    }
    command += [f"{option}={os.environ[name]}" for name, option in given.items() if name in os.environ]
    started = time.perf_counter()
    subprocess.run([*command, "."], cwd=ROOT, env={**os.environ, "DOCKER_BUILDKIT": "1"}, check=True)
    print(f"Built in {time.perf_counter() - started:.0f} s")


def check_contents() -> None:
    """The image is small, has no torch and doesn't run as root."""
    facts = json.loads(output(DOCKER, "image", "inspect", IMAGE).stdout)[0]
    megabytes = facts["Size"] / 1e6
    print(f"Image: {megabytes:.0f} MB")
    expect(megabytes < MAX_MEGABYTES, f"the image has at most {MAX_MEGABYTES} MB")
    expect(facts["Config"]["User"].split(":")[0] not in ("", "0", "root"), "it doesn't run as root")
    code = "import importlib.util; print(importlib.util.find_spec('torch'))"
    without_torch = output(DOCKER, "run", "--rm", "--network", "none", "--entrypoint", "python", IMAGE, "-c", code)
    expect(without_torch.stdout.strip() == "None", "there is no torch in it")


def check_cold_start() -> None:
    """Time from `docker run` to the first frame, with a read-only root and no capabilities; nothing is compiled."""
    port = free_port()
    where = ["--network", "host", "-e", "MSDGS_HOST=127.0.0.1", "-e", f"MSDGS_PORT={port}"]
    started = time.perf_counter()
    container = output(DOCKER, "run", "--detach", *HARDENED, *where, IMAGE).stdout.strip()
    try:
        running = time.perf_counter()
        response = wait_for(lambda: frame(f"http://127.0.0.1:{port}", 0.5, size=400))
        ended = time.perf_counter()
        print(
            f"First frame {ended - running:.1f} s after the container ran ({ended - started:.1f} s with its creation)"
        )
        expect(response.body[:8] == b"\x89PNG\r\n\x1a\n", "a frame is a PNG")
        count = "find {} -name '*.nbc' | wc -l"
        stored = sh(container, count.format("/opt/msdgs/lib/python3*/site-packages/msdgs_serve"))
        copied = sh(container, count.format("/tmp"))
        expect(
            int(stored) > 0 and stored == copied, f"no kernel is compiled at the start ({stored} stored, {copied} then)"
        )
        check_rights(container, "/tmp")
        ready = output(DOCKER, "exec", container, "python", "/opt/msdgs/ready.py", check=False)
        expect(ready.returncode == 0, "its health check passes")
        stopping = time.perf_counter()
        output(DOCKER, "stop", container)
        code = output(DOCKER, "inspect", "--format", "{{.State.ExitCode}}", container).stdout.strip()
        expect(code == "0", f"it stops on SIGTERM, after {time.perf_counter() - stopping:.1f} s")
    finally:
        output(DOCKER, "rm", "--force", container, check=False)


def check_rights(container: str, *writable: str) -> None:
    """The user of a container has no privileges and can't run programs of its own."""
    facts = json.loads(output(DOCKER, "inspect", container).stdout)[0]["HostConfig"]
    expect(facts["Memory"] > 0 and facts["PidsLimit"] > 0, "its memory and processes are limited")
    expect(output(DOCKER, "exec", container, "touch", "/opt/x", check=False).returncode != 0, "the root is read-only")
    for folder in writable:
        ended = sh(container, f"cp /bin/true {folder}/copied && {folder}/copied; echo $?; rm {folder}/copied")
        expect(ended == "126", f"nothing can be executed in {folder}, which is writable")
    expect(sh(container, "id -u") != "0", "its user isn't root")
    status = dict(line.split(":\t", 1) for line in sh(container, "cat /proc/1/status").splitlines())
    expect(status["Seccomp"] == "2", "Docker's seccomp profile holds")
    expect(int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0, "it has no capabilities and can't get any")
    expect(status["NoNewPrivs"] == "1", "it can't gain privileges")


@contextmanager
def composition(replicas: int, **settings: str) -> Iterator[str]:
    """Start the composition with some replicas; yield the address of its proxy."""
    port = free_port()
    chosen = {"MSDGS_IMAGE": IMAGE, "PROXY_IMAGE": PROXY_IMAGE, "PORT": f"127.0.0.1:{port}", **settings}
    environment = {**os.environ, **chosen}
    command = [DOCKER, "compose", "-p", PROJECT, "-f", "docker/compose.yaml"]
    try:
        up = ["up", "--detach", "--no-build", "--scale", f"render={replicas}"]
        subprocess.run([*command, *up], cwd=ROOT, env=environment, check=True)
        url = f"http://127.0.0.1:{port}"
        wait_for(lambda: get(f"{url}/ready"))
        for name in containers("render"):
            status = "python /opt/msdgs/ready.py && echo 200 || echo 503"
            wait_for(lambda name=name, status=status: Response(int(sh(name, status) or 503), Message(), b""))
        yield url
    finally:
        subprocess.run([*command, "down", "--volumes"], cwd=ROOT, env=environment, check=False, capture_output=True)


def check_cache(url: str) -> None:
    """A frame is rendered once, cached for a second, then revalidated by its ETag."""
    first = frame(url, 0.25)
    second = frame(url, 0.25)
    expect((first.headers["x-cache"], second.headers["x-cache"]) == ("MISS", "HIT"), "a frame is taken from the cache")
    expect(first.body == second.body and first.headers["etag"] == second.headers["etag"], "it has the same bytes")
    expect(["server-timing" in r.headers for r in (first, second)] == [True, False], "only rendered frames have times")
    known = frame(url, 0.25, headers={"If-None-Match": first.headers["etag"]})
    expect((known.status, known.body) == (304, b""), "a matching ETag gets a 304")
    time.sleep(2.2)  # nginx counts whole seconds: one that lasts 1 s may be fresh for 2
    expect(frame(url, 0.25).headers["x-cache"] == "REVALIDATED", "an expired frame is revalidated, not rendered again")
    keyed = frame(url, 0.25, headers={"X-API-Key": "some"})
    expect((keyed.status, keyed.headers["x-cache"]) == (200, "BYPASS"), "requests with a key bypass the cache")
    keyed = frame(url, 0.25, headers={"X-API-Key": "some", "If-None-Match": first.headers["etag"]})
    expect((keyed.status, keyed.body) == (304, b""), "their own ETags count")
    expect(get(f"{url}/metrics").status == 404, "metrics are not public")
    expect(get(f"{url}/").status == 200, "the viewer is served")


def check_affinity(url: str) -> None:
    """GET and POST requests for one time go to one replica; all replicas are used."""
    marked = "affinity"
    times = [number / 32 for number in range(32)]
    for t in times:
        frame(url, t, azimuth=1, headers={"X-Request-ID": f"{marked}.{t}.link"})
        for azimuth in (2, 3):
            post(url, t, azimuth, f"{marked}.{t}.call{azimuth}")
    served: dict[str, set[str]] = {}
    for entry in log():
        if entry["id"].startswith(marked):
            served.setdefault(entry["id"].split(".call")[0].split(".link")[0], set()).add(entry["replica"])
    by_call_and_link = [len(replicas) for replicas in served.values()]
    expect(len(by_call_and_link) == len(times), "every frame is in the log")
    alone = by_call_and_link.count(1)
    expect(alone >= 0.9 * len(times), f"{alone} of {len(times)} times have one replica")
    used = set[str]().union(*served.values())
    expect(len(used) == REPLICAS, f"{REPLICAS} replicas share the work")


def check_kill(url: str) -> None:
    """A replica is killed while clients request new frames: no request fails."""
    numbers, statuses, slowest = itertools.count(), list[int](), 0.0
    lock, victim = threading.Lock(), containers("render")[0]

    def ask(_: int) -> None:
        nonlocal slowest
        number = next(numbers)
        if number == LOAD // 3:
            output(DOCKER, "kill", victim)
        started = time.perf_counter()
        status = post(url, (number % 97) / 97, 10 + number, f"kill.{number}").status
        with lock:
            statuses.append(status)
            slowest = max(slowest, time.perf_counter() - started)

    with ThreadPoolExecutor(CLIENTS) as pool:
        list(pool.map(ask, range(LOAD)))
    good = statuses.count(200)
    expect(good == LOAD, f"{good} of {LOAD} frames came while a replica was killed, the slowest after {slowest:.1f} s")


def check_uploads(url: str) -> None:
    """A scene is added, rendered and deleted with a key that permits it; a damaged file is refused."""
    (container,) = containers("render")
    check_rights(container, "/tmp", "/uploads")
    whole = (ROOT / "examples" / "toys.onnx").read_bytes()
    expect(frame(url, 0.5).status == 401, "frames need a key")
    before = frame(url, 0.5, headers=CAN_READ).body
    expect(upload(url, whole, CAN_READ) == 403, "a key with the scope `read` can't upload")
    expect(upload(url, whole[: len(whole) // 2]) == 422, "a truncated file is refused")
    expect(upload(url, whole) == 201, "a valid file is accepted")
    expect(
        frame(url, 0.5, headers=CAN_READ, scene="sent").body == before,
        "its frames equal those of the scene in the image",
    )
    deleted = ask(urllib.request.Request(f"{url}/scenes/sent", headers=CAN_WRITE, method="DELETE"))
    expect(deleted.status == 204, "it can be deleted")
    expect(frame(url, 0.5, headers=CAN_READ).body == before, "frames of the other scene are unchanged")


def check_hostile_uploads(url: str) -> None:
    """Files that take memory or time, or read other files, are refused while a scene is rendered; none is left."""
    try:
        import onnx

        from tests.support.hostile_scenes import ATTACKS
        from tests.support.scene_files import write_scene
    except ImportError as missing:
        print(f"not checked: hostile files ({missing})")
        return
    (container,) = containers("render")
    with tempfile.TemporaryDirectory() as folder:
        sound = write_scene(Path(folder) / "sound.onnx").read_bytes()
    left, before = sh(container, "find /tmp /uploads"), frame(url, 0.5, headers=CAN_READ).body
    statuses, frames = list[int](), list[bytes]()
    with ThreadPoolExecutor(1) as pool:
        for attack in ATTACKS:
            contents = attack.on(onnx.load_from_string(sound), Path("/opt/msdgs/ready.py"))
            response = pool.submit(upload, url, contents)
            while not response.done():
                frames.append(frame(url, 0.5, headers=CAN_READ).body)
            statuses.append(response.result())
    frames.append(frame(url, 0.5, headers=CAN_READ).body)
    expect(statuses == [422] * len(ATTACKS), f"{statuses.count(422)} of {len(ATTACKS)} hostile files are refused")
    expect(set(frames) == {before}, f"{len(frames)} frames during and after the uploads are unchanged")
    expect(sh(container, "find /tmp /uploads") == left, "no file is left")
    peak = sh(container, "cat /sys/fs/cgroup/memory.peak || cat /sys/fs/cgroup/memory/memory.max_usage_in_bytes")
    expect(int(peak) < MAX_MEMORY, f"peak memory of the container: {int(peak) / 1e6:.0f} MB")


def frame(
    url: str,
    t: float,
    *,
    scene: str = "toys",
    size: int = 64,
    azimuth: int = 30,
    headers: dict[str, str] | None = None,
) -> Response:
    """Request a frame by GET."""
    link = f"{url}/render?scene={scene}&azimuth={azimuth}&elevation=20&t={t}&width={size}&height={size}"
    return get(link, headers)


def upload(url: str, contents: bytes, headers: dict[str, str] = CAN_WRITE) -> int:
    """Upload a scene as `sent`; returns the status."""
    return ask(urllib.request.Request(f"{url}/scenes?name=sent", contents, headers, method="POST")).status


def post(url: str, t: float, azimuth: int, request_id: str) -> Response:
    """Request a frame by POST."""
    camera = {"type": "orbit", "azimuth": azimuth, "elevation": 20}
    body = {"scene": "toys", "camera": camera, "t": t, "width": 64, "height": 64}
    headers = {"Content-Type": "application/json", "X-Request-ID": request_id}
    return ask(urllib.request.Request(f"{url}/render", json.dumps(body).encode(), headers))


def get(url: str, headers: dict[str, str] | None = None) -> Response:
    """Return status and body of a GET; status 0 without a response."""
    return ask(urllib.request.Request(url, headers=headers or {}))


def ask(request: urllib.request.Request) -> Response:
    """Return status and body of a request; status 0 without a response."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with direct.open(request, timeout=60) as response:
            return Response(response.status, response.headers, response.read())
    except urllib.error.HTTPError as error:
        return Response(error.code, error.headers, error.read())
    except OSError:
        return Response(0, Message(), b"")


def wait_for(attempt: Callable[[], Response]) -> Response:
    """Return the first response with status 200."""
    deadline = time.monotonic() + MAX_START_SECONDS
    while time.monotonic() < deadline:
        response = attempt()
        if response.status == 200:
            return response
        time.sleep(0.05)
    sys.exit(f"FAILED: not ready after {MAX_START_SECONDS:.0f} s")


def containers(service: str) -> list[str]:
    """Return the ids of a service's containers."""
    labels = {"com.docker.compose.project": PROJECT, "com.docker.compose.service": service}
    filters = [part for name, value in labels.items() for part in ("--filter", f"label={name}={value}")]
    return output(DOCKER, "ps", "--quiet", *filters).stdout.split()


def log() -> list[dict[str, str]]:
    """Return the proxy's access log."""
    lines = output(DOCKER, "logs", containers("proxy")[0]).stdout.splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


def sh(container: str, script: str) -> str:
    """Run a script in a container; returns its output."""
    return output(DOCKER, "exec", container, "sh", "-c", script, check=False).stdout.strip()


def output(*command: str, check: bool = True) -> "subprocess.CompletedProcess[str]":
    """Run a command and capture its output."""
    return subprocess.run(command, check=check, capture_output=True, text=True)


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def expect(holds: bool, claim: str) -> None:
    """Print a claim that holds; exit if it doesn't."""
    if not holds:
        sys.exit(f"FAILED: {claim}")
    print(f"ok: {claim}")


if __name__ == "__main__":
    sys.exit(main())
