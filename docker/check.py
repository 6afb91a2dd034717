"""Check the image and the composition: build, run with few rights, lose and add replicas under load.

    python docker/check.py                                    with images from the default registry
    BASE_IMAGE=… PROXY_IMAGE=… python docker/check.py         with other images, such as local ones

Environment variables: BASE_IMAGE, PIP_INDEX_URL, NPM_REGISTRY, MSDGS_IMAGE, PROXY_IMAGE as in compose.yaml; CA_FILE,
certificates for the build; BUILD_NETWORK, `host` if containers have no other; DOCKER, the command.
Without a daemon it prints the reason and the exit status is 77. Containers, network and volumes are removed at the end.
"""

import json
import os
import shutil
import sys
import tempfile
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from check_replicas import check_replicas
from composition import (
    BASE_IMAGE,
    DOCKER,
    IMAGE,
    PROXY_IMAGE,
    ROOT,
    Composition,
    ask,
    composition,
    containers,
    expect,
    frame,
    free_port,
    get,
    log,
    output,
    post,
    sh,
    video,
    wait_for,
)

sys.path.insert(0, str(ROOT))  # to import `tests`
SKIPPED = 77
REPLICAS = (1, 2, 3)
KEYS = {"read": "reader-0123456789", "write": "writer-0123456789"}
CAN_READ, CAN_WRITE = ({"X-API-Key": KEYS[scope]} for scope in ("read", "write"))
MAX_MEGABYTES = 600
"""Maximum size of the image without its base."""
MAX_MEMORY = 1e9
"""Maximum memory of a replica in bytes, hostile uploads included."""
HARDENED = [
    "--read-only", "--tmpfs", "/tmp:noexec,nosuid,nodev,size=256m", "--cap-drop", "ALL",
    "--security-opt", "no-new-privileges", "--memory", "4g", "--memory-swap", "4g", "--pids-limit", "512",
]  # fmt: skip


class Skipped(Exception):
    """Nothing can be checked here."""


def main() -> int:
    """Run all checks; the first failure ends the program."""
    try:
        available()
    except Skipped as reason:
        print(f"skipped: {reason}")
        return SKIPPED
    started = time.perf_counter()
    Composition().build()
    print(f"Built in {time.perf_counter() - started:.0f} s")
    check_contents()
    check_cold_start()
    with composition(1, MSDGS_FRAME_MAX_AGE="3600") as running:
        check_start_message()
        check_cache(running.url)
        check_videos(running.url)
    for replicas in REPLICAS:
        print(f"With {replicas} replica(s):")
        with composition(replicas) as running:
            check_revalidation(running.url)
            check_affinity(running.url, replicas)
            check_replicas(running, replicas)
    with tempfile.NamedTemporaryFile("w") as keys:
        keys.write("".join(f"{scope} {key}\n" for scope, key in KEYS.items()))
        keys.flush()
        os.chmod(keys.name, 0o644)  # for user 10001
        with composition(1, MSDGS_UPLOADS="true", API_KEYS=keys.name) as running:
            check_uploads(running.url)
            check_hostile_uploads(running.url)
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


def check_contents() -> None:
    """The image is small, has no torch and doesn't run as root."""
    facts, base = json.loads(output(DOCKER, "image", "inspect", IMAGE, BASE_IMAGE).stdout)
    megabytes = (facts["Size"] - base["Size"]) / 1e6
    expect(megabytes < MAX_MEGABYTES, f"the image has {megabytes:.0f} MB beside its base, at most {MAX_MEGABYTES}")
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


def check_start_message() -> None:
    """The log of a replica names the address on which it listens."""
    (container,) = containers("render")
    printed = output(DOCKER, "logs", container).stdout
    expect("Listening on http://0.0.0.0:8000" in printed, "a replica prints the address on which it listens")


def check_cache(url: str) -> None:
    """A frame is rendered once; it stays fresh for longer than this takes on a busy machine."""
    first = frame(url, 0.25)
    second = frame(url, 0.25)
    expect((first.headers["x-cache"], second.headers["x-cache"]) == ("MISS", "HIT"), "a frame is taken from the cache")
    expect(first.body == second.body and first.headers["etag"] == second.headers["etag"], "it has the same bytes")
    expect(["server-timing" in r.headers for r in (first, second)] == [True, False], "only rendered frames have times")
    known = frame(url, 0.25, headers={"If-None-Match": first.headers["etag"]})
    expect((known.status, known.body) == (304, b""), "a matching ETag gets a 304")
    keyed = frame(url, 0.25, headers={"X-API-Key": "some"})
    expect((keyed.status, keyed.headers["x-cache"]) == (200, "BYPASS"), "requests with a key bypass the cache")
    keyed = frame(url, 0.25, headers={"X-API-Key": "some", "If-None-Match": first.headers["etag"]})
    expect((keyed.status, keyed.body) == (304, b""), "their own ETags count")
    expect(get(f"{url}/metrics").status == 404, "metrics are not public")
    expect(get(f"{url}/").status == 200, "the viewer is served")
    expect(get(f"{url}/viewer/onnxruntime-web/ort.js").status == 200, "the viewer can draw by itself")


def check_revalidation(url: str) -> None:
    """A frame that is fresh for a second is then revalidated by its ETag."""
    expect(frame(url, 0.25).headers["x-cache"] == "MISS", "a frame is rendered")
    time.sleep(2.2)  # nginx counts whole seconds: one that lasts 1 s may be fresh for 2
    expect(frame(url, 0.25).headers["x-cache"] == "REVALIDATED", "an expired frame is revalidated, not rendered again")


def check_affinity(url: str, replicas: int) -> None:
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
    by_call_and_link = [len(each) for each in served.values()]
    expect(len(by_call_and_link) == len(times), "every frame is in the log")
    alone = by_call_and_link.count(1)
    expect(alone >= 0.9 * len(times), f"{alone} of {len(times)} times have one replica")
    used = set[str]().union(*served.values())
    expect(len(used) == replicas, f"{replicas} replicas share the work")


def check_videos(url: str) -> None:
    """Videos of all formats are rendered."""
    for name, marks in {"mp4": b"ftyp", "webm": b"webm", "webp": b"WEBP"}.items():
        response = video(url, name)
        expect(response.status == 200 and marks in response.body[:64], f"a video is {name}")


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


def upload(url: str, contents: bytes, headers: dict[str, str] = CAN_WRITE) -> int:
    """Upload a scene as `sent`; returns the status."""
    return ask(urllib.request.Request(f"{url}/scenes?name=sent", contents, headers, method="POST")).status


if __name__ == "__main__":
    sys.exit(main())
