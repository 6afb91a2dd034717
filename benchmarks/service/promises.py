"""What the service promises where clients or operators misbehave, each measured on a service of its own."""

import contextlib
import http.client
import json
import os
import select
import shutil
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.service.process import MOMENT, Connection, Running, service
from benchmarks.service.requests import digest
from tests.support.scene_files import write_scene

ORBIT = {"type": "orbit", "azimuth": 30, "elevation": 20}
SMALL = {"camera": ORBIT, "t": 0.5, "width": 16, "height": 16}
LEFT_AT = (0.1, 0.5, 0.9)
IN_FLIGHT = 8
HALF_A_CALL = b"POST /render HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n{"
SLOW_BEGINNINGS = (b"", b"GET /live HTTP/1.1\r\n", HALF_A_CALL)
SLOW_PATIENCE = 30.0


def blurred(size: int, samples: int) -> dict[str, Any]:
    """A frame that takes as long as so many."""
    return {**SMALL, "width": size, "height": size, "shutter": {"open": -0.1, "close": 0.1, "samples": samples}}


def seconds_until_free(scene: Path) -> list[float]:
    """How long the service works on for a client that has left a frame of 64 moments after a part of its time."""
    body = blurred(400, 64)
    with service(scene) as running:
        started = time.monotonic()
        assert running.ask("POST", "/render", body).status == 200
        whole = time.monotonic() - started
        return [_leave_after(running, body, part * whole) for part in LEFT_AT]


def _leave_after(running: Running, body: dict[str, Any], seconds: float) -> float:
    connection = http.client.HTTPConnection("127.0.0.1", running.port)
    leaving = threading.Timer(seconds, lambda: connection.sock.shutdown(socket.SHUT_RDWR))
    leaving.start()
    with contextlib.suppress(OSError):
        _send(connection, body)
    leaving.join()
    connection.close()
    left = time.monotonic()
    _until(lambda: running.metric("msdgs_renders_running") == 0)
    return time.monotonic() - left


def _send(connection: http.client.HTTPConnection, body: dict[str, Any]) -> None:
    connection.request("POST", "/render", json.dumps(body), {"Content-Type": "application/json"})
    connection.getresponse().read()


def seconds_to_deadline(scene: Path) -> float:
    """Until a frame of far more than 10 s is answered by 504, where a request has 1 s."""
    with service(scene, render_seconds=1, max_samples=10_000) as running:
        started = time.monotonic()
        assert running.ask("POST", "/render", blurred(800, 10_000)).status == 504
        return time.monotonic() - started


def stops_gently(scene: Path) -> bool:
    """Whether 8 frames in flight are finished after SIGTERM, while /ready says 503 and /live 200."""
    with service(scene) as running, ThreadPoolExecutor(IN_FLIGHT) as pool:
        frames = [pool.submit(running.ask, "POST", "/render", blurred(300, 16)) for _ in range(IN_FLIGHT)]
        _until(lambda: running.metric("msdgs_queue_waiting") + running.metric("msdgs_renders_running") == IN_FLIGHT)
        running.process.send_signal(signal.SIGTERM)
        time.sleep(0.1)
        health = [running.ask("GET", path).status for path in ("/ready", "/live")]
        statuses = {frame.result().status for frame in frames}
        return health == [503, 200] and statuses == {200} and running.process.wait(30) == 0


def slow_sockets(scene: Path, count: int = 200) -> tuple[float, Counter[int]]:
    """Seconds until sockets that send nothing, half of the headers or of a body are closed; how others fared."""
    statuses: Counter[int] = Counter()
    with service(scene) as running:
        sockets = [socket.create_connection(("127.0.0.1", running.port)) for _ in range(count)]
        started = time.monotonic()
        for number, each in enumerate(sockets):
            each.sendall(SLOW_BEGINNINGS[number % len(SLOW_BEGINNINGS)])
        waiting, connection = set(sockets), Connection(running.port)
        while waiting and time.monotonic() - started < SLOW_PATIENCE:
            statuses[connection.ask("POST", "/render", {**SMALL, "width": 200, "height": 200}).status] += 1
            for each in select.select(list(waiting), [], [], 0.05)[0]:
                if _is_closed(each):
                    waiting.discard(each)
        took = time.monotonic() - started
        for each in sockets:
            each.close()
        return (took if not waiting else float("inf")), statuses


def _is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(65536) == b""
    except ConnectionResetError:
        return True


def reloads(folder: Path, count: int = 100, clients: int = 4) -> tuple[int, int, Counter[int]]:
    """A scene swapped so often while clients ask: frames, those that belong to no version, and statuses."""
    versions = [write_scene(folder / "red.other"), write_scene(folder / "blue.other", static_color=(0.0, 0.0, 1.0))]
    scene, stop = folder / "scene.onnx", threading.Event()
    seen: Counter[str] = Counter()
    statuses: Counter[int] = Counter()
    body = {**SMALL, "scene": "scene", "width": 96, "height": 96}

    def put(version: Path) -> None:
        shutil.copyfile(version, folder / "new")
        os.replace(folder / "new", scene)

    def ask(running: Running) -> None:
        connection = Connection(running.port)
        while not stop.is_set():
            answer = connection.ask("POST", "/render", body)
            statuses[answer.status] += 1
            seen[digest(answer.body)] += 1
        connection.close()

    put(versions[0])
    with service(folder, watch_seconds=0.05) as running:
        known = set()
        for version in (*versions, versions[0]):
            put(version)
            time.sleep(1)
            known.add(digest(running.ask("POST", "/render", body).body))
        assert len(known) == len(versions)
        threads = [threading.Thread(target=ask, args=(running,)) for _ in range(clients)]
        for thread in threads:
            thread.start()
        for number in range(count):
            put(versions[(number + 1) % 2])
            time.sleep(0.15)
        stop.set()
        for thread in threads:
            thread.join()
    return seen.total(), sum(times for frame, times in seen.items() if frame not in known), statuses


def survives_kills(folder: Path, times: int = 5) -> tuple[int, int]:
    """The process is killed while a scene is uploaded again and again and half of another is on its way: after how many
    kills it served a whole version and nothing else was left; and how many uploads there were."""
    versions = [write_scene(folder / "red.other"), write_scene(folder / "blue.other", static_color=(0.0, 0.0, 1.0))]
    contents = [version.read_bytes() for version in versions]
    scene = folder / "scene.onnx"
    scene.write_bytes(contents[0])
    whole, uploads = 0, 0
    for number in range(times + 1):
        with service(folder, uploads=True) as running:
            frame = running.ask("POST", "/render", {**SMALL, "scene": "scene"})
            left = sorted(path.name for path in folder.iterdir() if path.suffix != ".other")
            whole += number > 0 and frame.status == 200 and scene.read_bytes() in contents and left == ["scene.onnx"]
            if number < times:
                uploads += _uploads_until_killed(running, folder, contents, 0.5 + 0.1 * number)
    return whole, uploads


def _uploads_until_killed(running: Running, folder: Path, contents: Sequence[bytes], seconds: float) -> int:
    uploads = 0
    with _half_an_upload(running.port):
        _until(lambda: len(list(folder.glob(".incoming-*"))) == 1)
        kill = threading.Timer(seconds, running.process.kill)
        kill.start()
        connection = Connection(running.port)
        with contextlib.suppress(OSError, http.client.HTTPException):
            while True:
                content = contents[uploads % len(contents)]
                assert connection.send("POST", "/scenes?name=scene&replace=true", content).status == 201
                uploads += 1
        kill.join()
    return uploads


@contextlib.contextmanager
def _half_an_upload(port: int) -> Iterator[None]:
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"POST /scenes?name=other HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\nhalf a scene")
        yield


def counts_agree(scene: Path, count: int) -> bool:
    """Whether /metrics say what a client counted after so many requests of different kinds."""
    kinds: list[tuple[str, str, Any, dict[str, str] | None]] = [
        ("POST", "/render", SMALL, None),
        ("POST", "/render", {**SMALL, "t": 7}, None),
        ("POST", "/render", SMALL, {"If-None-Match": "*"}),
        ("GET", "/live", None, None),
        ("GET", "/scenes", None, None),
    ]
    counted: Counter[str] = Counter()
    with service(scene) as running:
        connection = Connection(running.port)
        for number in range(count):
            method, path, body, headers = kinds[number % len(kinds)]
            status = connection.ask(method, path, body, headers).status
            counted[f'{{method="{method}",route="{path}",status="{status}"}}'] += 1
        text = connection.ask("GET", "/metrics").body.decode()
        connection.close()
    lines = [line.removeprefix("msdgs_requests_total").rsplit(" ", 1) for line in text.splitlines()
             if line.startswith("msdgs_requests_total{") and 'route="/ready"' not in line]  # fmt: skip
    return {labels: float(value) for labels, value in lines} == dict(counted) and len(counted) == len(kinds)


def _until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    started = time.monotonic()
    while not condition():
        assert time.monotonic() - started < seconds
        time.sleep(MOMENT)
