"""Fault injection: clients and operators that misbehave, each case on a service of its own."""

import contextlib
import http.client
import json
import os
import select
import shutil
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.service.levels import Row, Settings
from benchmarks.service.load import saturate
from benchmarks.service.process import JSON, Connection, Running, service
from benchmarks.service.requests import Wanted, digest
from tests.support.processes import wait_for
from tests.support.scene_files import write_scene

ORBIT = {"type": "orbit", "azimuth": 30, "elevation": 20}
SMALL = {"camera": ORBIT, "t": 0.5, "width": 16, "height": 16}
SLOW_SOCKETS, RELOADS, RELOAD_CLIENTS, KILLS = 200, 100, 4, 5
RELOAD_SECONDS = 0.15
HALF_A_CALL = b"POST /render HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n{"
SLOW_BEGINNINGS = (b"", b"GET /live HTTP/1.1\r\n", HALF_A_CALL)
SLOW_PATIENCE = 30.0


def faults(settings: Settings) -> Iterator[Row]:
    """Clients that disconnect, are slow or ask for too much."""
    yield _disconnects(settings.scene)
    yield _deadline(settings.scene)
    yield _slow_sockets(settings.scene)


def changes(settings: Settings) -> Iterator[Row]:
    """A scene file that is replaced a hundred times under load."""
    folder = settings.work / "changing"
    versions, scene = _versions(folder), folder / "scene.onnx"
    wanted = Wanted("scene", 30.0, 0.5, 96, "png")

    def put(version: Path) -> None:
        shutil.copyfile(version, folder / "new")
        os.replace(folder / "new", scene)

    put(versions[0])
    with service(folder, watch_seconds=0.05) as running, ThreadPoolExecutor(1) as pool:
        known = set()
        for version in (*versions, versions[0]):
            put(version)
            time.sleep(1)
            known.add(digest(running.ask("POST", "/render", wanted.body()).body))
        assert len(known) == len(versions)
        clients = pool.submit(saturate, running, [wanted], RELOAD_CLIENTS, RELOADS * RELOAD_SECONDS)
        for number in range(RELOADS):
            put(versions[(number + 1) % 2])
            time.sleep(RELOAD_SECONDS)
        tally = clients.result()
    mixed = sum(times for (_, frame), times in tally.bodies.items() if frame not in known)
    measured = f"{mixed} of {tally.bodies.total()} frames match no version, {dict(tally.statuses)}"
    fine = not mixed and set(tally.statuses) == {200}
    yield Row(f"{RELOADS} reloads under load: frames of mixed versions", "none", measured, fine)


def kills(settings: Settings) -> Iterator[Row]:
    """kill -9 while one scene is uploaded again and again, and half of another has arrived."""
    folder = settings.work / "killed"
    contents = [version.read_bytes() for version in _versions(folder)]
    scene = folder / "scene.onnx"
    scene.write_bytes(contents[0])
    whole, uploads = 0, 0
    for number in range(KILLS + 1):
        with service(folder, uploads=True) as running:
            frame = running.ask("POST", "/render", {**SMALL, "scene": "scene"})
            wait_for(lambda: not list(folder.glob(".incoming-*")))
            left = sorted(path.name for path in folder.iterdir() if path.suffix != ".other")
            whole += number > 0 and frame.status == 200 and scene.read_bytes() in contents and left == ["scene.onnx"]
            if number < KILLS:
                uploads += _uploads_until_killed(running, folder, contents, 0.5 + 0.1 * number)
    measured = f"{whole} of {KILLS}, after {uploads} uploads"
    yield Row("kill -9 during uploads: a whole scene, no other file left", "all", measured, whole == KILLS)


def _disconnects(scene: Path) -> Row:
    """Seconds that the service works on for a client that disconnects during a frame of 64 samples."""
    body = _long_frame(400, 64)
    with service(scene) as running:
        started = time.monotonic()
        assert running.ask("POST", "/render", body).status == 200
        whole = time.monotonic() - started
        seconds = [_disconnect_after(running, body, part * whole) for part in (0.1, 0.5, 0.9)]
    measured = ", ".join(f"{each:.2f}" for each in seconds) + " s"
    return Row("client gone at 10, 50, 90 %: work ends within", "0.5 s", measured, max(seconds) < 0.5)


def _disconnect_after(running: Running, body: dict[str, Any], seconds: float) -> float:
    connection = http.client.HTTPConnection("127.0.0.1", running.port)
    disconnect = threading.Timer(seconds, lambda: connection.sock.shutdown(socket.SHUT_RDWR))
    disconnect.start()
    with contextlib.suppress(OSError):
        connection.request("POST", "/render", json.dumps(body), JSON)
        connection.getresponse().read()
    disconnect.join()
    connection.close()
    gone = time.monotonic()
    wait_for(lambda: running.metric("msdgs_renders_running") == 0)
    return time.monotonic() - gone


def _deadline(scene: Path) -> Row:
    """Seconds until a frame of far more than 10 s is answered by 504 if a request may take 1 s."""
    with service(scene, render_seconds=1, max_samples=10_000) as running:
        started = time.monotonic()
        assert running.ask("POST", "/render", _long_frame(800, 10_000)).status == 504
        late = time.monotonic() - started
    return Row("1 s deadline on a render of more than 10 s: 504 after", "1.5 s", f"{late:.2f} s", late < 1.5)


def _slow_sockets(scene: Path) -> Row:
    """Seconds until sockets that send nothing, half of the headers or half of a body are closed, and the statuses of a
    client meanwhile."""
    statuses: Counter[int] = Counter()
    with service(scene) as running:
        sockets = [socket.create_connection(("127.0.0.1", running.port)) for _ in range(SLOW_SOCKETS)]
        started = time.monotonic()
        for number, each in enumerate(sockets):
            each.sendall(SLOW_BEGINNINGS[number % len(SLOW_BEGINNINGS)])
        waiting, connection = set(sockets), Connection(running.port)
        while waiting and time.monotonic() - started < SLOW_PATIENCE:
            statuses[connection.ask("POST", "/render", {**SMALL, "width": 200, "height": 200}).status] += 1
            waiting -= {each for each in select.select(list(waiting), [], [], 0.05)[0] if _is_closed(each)}
        took = time.monotonic() - started if not waiting else float("inf")
        for each in sockets:
            each.close()
    fine = took < 15 and set(statuses) == {200}
    measured = f"{took:.1f} s, {dict(statuses)}"
    return Row(f"{SLOW_SOCKETS} slow sockets are closed; other requests meanwhile", "15 s, all 200", measured, fine)


def _is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(65536) == b""
    except ConnectionResetError:
        return True


def _uploads_until_killed(running: Running, folder: Path, contents: Sequence[bytes], seconds: float) -> int:
    uploads = 0
    with socket.create_connection(("127.0.0.1", running.port)) as half:
        half.sendall(b"POST /scenes?name=other HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\nhalf a scene")
        wait_for(lambda: len(list(folder.glob(".incoming-*"))) == 1)
        kill = threading.Timer(seconds, running.process.kill)
        kill.start()
        connection = Connection(running.port)
        with contextlib.suppress(OSError, http.client.HTTPException):
            while True:
                content = contents[uploads % len(contents)]
                assert connection.send("POST", "/scenes?name=scene&replace=true", content).status == 201
                uploads += 1
        kill.join()
    for file in folder.glob(".incoming-*"):
        os.utime(file, (0, 0))  # only old ones are removed
    return uploads


def _versions(folder: Path) -> list[Path]:
    """Two scenes of different color in a new folder."""
    folder.mkdir()
    return [write_scene(folder / "red.other"), write_scene(folder / "blue.other", static_color=(0.0, 0.0, 1.0))]


def _long_frame(size: int, samples: int) -> dict[str, Any]:
    """A request for a frame with motion blur, which takes as long as `samples` frames."""
    return {**SMALL, "width": size, "height": size, "shutter": {"open": -0.1, "close": 0.1, "samples": samples}}
