"""Checks for docker/check.py: no request is lost while replicas come, go or hang."""

import itertools
import re
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from composition import DOCKER, ROOT, Composition, Response, containers, expect, frame, get, log, output, post

CLIENTS = 4
SETTLED_SECONDS = 3.0
"""How long clients go on after a change: longer than the proxy takes to notice one."""
READ_SECONDS = float(re.findall(r"proxy_read_timeout (\d+)s", (ROOT / "docker/nginx/nginx.conf").read_text())[0])
"""How long the proxy waits for a replica."""


class Load(NamedTuple):
    """Responses to clients that each ask for one thing after the other."""

    failed: list[str]
    seconds: list[float]


def check_replicas(running: Composition, replicas: int) -> None:
    """Replicas are added, removed, stopped and killed under load, down to one, and one hangs: no request fails."""

    def on_one(command: str) -> Callable[[], object]:
        return lambda: output(DOCKER, command, containers("render")[0])

    changes = {
        "a replica was added": lambda: running.scale(replicas + 1),
        "it was removed": lambda: running.scale(replicas),
    }
    if replicas > 1:
        changes |= {
            "one was killed": on_one("kill"),
            "one was started in its place": lambda: running.scale(replicas),
            "one was stopped": on_one("stop"),
            "one was started again": lambda: running.scale(replicas),
            "all but one were removed": lambda: running.scale(1),
            "they were added again": lambda: running.scale(replicas),
        }
    for name, change in changes.items():
        expect_all(running.url, change, f"while {name}")
    if replicas > 1:
        check_hung(running)
    methods = {entry["method"] for entry in log() if entry["id"].startswith("load.post")}
    expect(methods == {"POST"}, "the log has the requests' own methods")


def check_hung(running: Composition) -> None:
    """Requests to a replica that hangs are answered by another, and later ones aren't sent to it."""
    (victim, *_) = containers("render")

    def hang() -> None:
        output(DOCKER, "pause", victim)
        time.sleep(READ_SECONDS)

    expect_all(running.url, hang, "while a replica hung")
    after = expect_all(running.url, lambda: None, "while it was left out")
    waited = sum(seconds > READ_SECONDS / 2 for seconds in after.seconds)
    expect(waited <= 1, f"{waited} of these waited for it, at most the one that finds out whether it still hangs")
    output(DOCKER, "unpause", victim)
    running.wait_until_ready()


def expect_all(url: str, change: Callable[[], object], when: str) -> Load:
    """Expect that no request fails during a change and after it."""
    load = under_load(url, change)
    reasons = "".join(f"\n  {count} × {reason}" for reason, count in Counter(load.failed).items())
    count, slowest = len(load.seconds), max(load.seconds)
    expect(
        not load.failed,
        f"{count - len(load.failed)} of {count} answers came {when}, the slowest after {slowest:.1f} s{reasons}",
    )
    return load


def under_load(url: str, change: Callable[[], object]) -> Load:
    """Make a change while clients ask for new frames, linked frames and the list of scenes."""
    numbers, ended, lock = itertools.count(), threading.Event(), threading.Lock()
    failed, seconds = list[str](), list[float]()

    def request(number: int) -> Response:
        t, azimuth = (number % 97) / 97, number % 360
        asks = (
            lambda: post(url, t, azimuth, f"load.post.{number}"),
            lambda: frame(url, t, azimuth=azimuth),
            lambda: get(f"{url}/scenes"),
        )
        return asks[number % len(asks)]()

    def client() -> None:
        while not ended.is_set():
            started = time.perf_counter()
            response = request(next(numbers))
            with lock:
                seconds.append(time.perf_counter() - started)
                if response.status != 200:
                    failed.append(f"{response.status} {response.body[:200].decode(errors='replace')}")

    with ThreadPoolExecutor(CLIENTS) as pool:
        clients = [pool.submit(client) for _ in range(CLIENTS)]
        try:
            time.sleep(1)
            change()
            time.sleep(SETTLED_SECONDS)
        finally:
            ended.set()
    for each in clients:
        each.result()  # a client that broke off has failed
    return Load(failed, seconds)
