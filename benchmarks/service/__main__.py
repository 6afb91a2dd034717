"""Service levels, measured from outside: a table of bounds, measured values, and whether each bound is met."""

import itertools
import re
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from benchmarks.service.faults import ORBIT, changes, faults, kills
from benchmarks.service.levels import SCENE, Row, Settings, memory_row, print_rows
from benchmarks.service.load import Health, Tally, at_rate, overload, saturate
from benchmarks.service.process import Connection, Running, make_scenes, service
from benchmarks.service.requests import Offline, Wanted, digest, images, mixed
from benchmarks.service.soak import shares, soak
from msdgs_serve.api.settings import Settings as ServiceSettings

CLIENTS = 32
REQUESTS = 96  # different requests of the mixed load
FIRST = "first"  # the scene of single measurements
DEFAULTS = ServiceSettings()
PLACES = (DEFAULTS.concurrent_renders + DEFAULTS.queued_renders) // 2  # of one address, rendering and waiting
OVERLOAD, OVERLOAD_TURNS, PEAK_SECONDS = 4, 10, 3
LOAD_MINUTES = 0.7  # of the mixed load
PACE = 0.5  # of the peak: below saturation
WARM_UP = 5  # calls


def cold_start(settings: Settings) -> Iterator[Row]:
    """From the start of the process to its first frame, with kernels compiled before."""
    took = []
    for _ in range(4):
        started = time.perf_counter()
        with service(settings.scene) as running:
            body = {"camera": ORBIT, "t": 0.5, "width": 400, "height": 400}
            assert running.ask("POST", "/render", body).status == 200
            took.append((time.perf_counter() - started, running.processor_seconds()))
    shortest, processor = min(took[1:])
    measured = f"{shortest:.2f} s, processor time {processor:.2f} s"
    yield Row("cold start to the first frame, best of 3", "< 3 s", measured, shortest < 3)


def overhead(settings: Settings) -> Iterator[Row]:
    """HTTP, validation, queue and encoding of a 400 × 400 JPEG, without posing and rendering."""
    with service(settings.folder) as running:
        beyond, client = _overheads(running, repeats=100)
    median = statistics.median(beyond)
    measured = f"{median:.1f} ms p50, minimum {min(beyond):.1f} ms, of which the client takes {client:.1f} ms"
    yield Row("400×400 JPEG, without posing and rendering", "< 8 ms p50", measured, median < 8)


def _overheads(running: Running, repeats: int) -> tuple[list[float], float]:
    """Milliseconds of calls without `pose` and `draw`, and the client's own processor time per call."""
    beyond, worked = [], 0.0
    with closing(Connection(running.port)) as connection:
        for number, wanted in enumerate(images(repeats + WARM_UP, FIRST)):
            if number == WARM_UP:
                beyond, worked = [], time.process_time()
            started = time.perf_counter()
            answer = connection.ask("POST", "/render", wanted.body())
            milliseconds = 1000 * (time.perf_counter() - started)
            assert answer.status == 200
            stages = dict(re.findall(r"(\w+);dur=([\d.]+)", answer.headers["server-timing"]))
            beyond.append(milliseconds - float(stages["pose"]) - float(stages["draw"]))
    return beyond, 1000 * (time.process_time() - worked) / repeats


def load(settings: Settings) -> Iterator[Row]:
    """32 clients, all scenes, times, sizes and formats mixed; every body is compared with the offline render."""
    requests, offline = mixed(REQUESTS, ["first", "second", "balls"]), Offline(settings.folder)
    expected = {wanted: digest(offline.draw(wanted)) for wanted in requests}
    before = _offline_rate(offline, requests)
    with service(settings.folder, queued_renders=2 * CLIENTS) as running:
        client = time.process_time()
        tally = saturate(running, requests, CLIENTS, settings.seconds(LOAD_MINUTES))
        client = (time.process_time() - client) / tally.lasted
    alone = (before + _offline_rate(offline, requests)) / 2
    bad = {status: count for status, count in tally.statuses.items() if status not in (200, 503)}
    title = f"{CLIENTS} clients, mixed requests, {tally.lasted:.0f} s"
    yield Row(f"{title}: 5xx other than 503", "none", str(bad or "none"), not bad)
    ratio = tally.frames_per_second / alone
    rates = f"{tally.frames_per_second:.1f} of {alone:.1f} frames/s: {ratio:.0%}"
    measured = f"{rates}; clients take {client:.0%} of a core"
    yield Row("throughput relative to renderer and encoder alone", ">= 90 %", measured, ratio >= 0.9)
    wrong = sum(count for (wanted, found), count in tally.bodies.items() if expected[wanted] != found)
    total = tally.bodies.total()
    yield Row("bodies equal to the offline render", "all", f"{total - wrong} of {total}", not wrong)
    yield memory_row("memory", tally.resident)


def _offline_rate(offline: Offline, requests: list[Wanted]) -> float:
    """Frames per second without HTTP, in one thread; the first call also poses, which the service does too."""
    started = time.perf_counter()
    for wanted in requests:
        offline.draw(wanted)
    return len(requests) / (time.perf_counter() - started)


def too_much(settings: Settings) -> Iterator[Row]:
    """Half of the peak rate, the peak and four times the peak, of 400 × 400 JPEGs.

    Peak and overload are measured in turns, since the speed of a machine may change by half within a minute.
    """
    requests = images(1000, FIRST)
    seconds = settings.overload_seconds / OVERLOAD_TURNS
    tallies, health = list[Tally](), list[Health]()
    with service(settings.folder) as running:
        peaks = [saturate(running, requests, 8, PEAK_SECONDS).frames_per_second]
        paced = at_rate(running, requests, CLIENTS, 15, PACE * peaks[0])
        for _ in range(OVERLOAD_TURNS):
            tally, looked = overload(running, requests, 64, seconds, OVERLOAD * peaks[-1])
            tallies.append(tally)
            health.append(looked)
            peaks.append(saturate(running, requests, 8, PEAK_SECONDS).frames_per_second)
    yield Row("8 clients, 400×400 JPEG", "", f"{', '.join(f'{peak:.0f}' for peak in peaks)} frames/s", None)
    ratio = paced.milliseconds(0.99) / paced.milliseconds(0.5)
    measured = f"{ratio:.1f} ({paced.milliseconds(0.5):.0f} and {paced.milliseconds(0.99):.0f} ms)"
    yield Row(f"at {PACE:.0%} of that: p99 / p50", "< 3", measured, ratio < 3)
    title = f"{OVERLOAD}× overload, {OVERLOAD_TURNS} × {seconds:.0f} s"
    late = np.concatenate([np.array(tally.seconds) * tally.frames_per_second / PLACES for tally in tallies])
    p99 = float(np.quantile(late, 0.99))
    measured = f"{p99:.2f} ({', '.join(f'{tally.milliseconds(0.99):.0f}' for tally in tallies)} ms)"
    yield Row(f"{title}: p99 of accepted requests / bound of the queue", "<= 2", measured, p99 <= 2)
    before_and_after = [(before + after) / 2 for before, after in itertools.pairwise(peaks)]
    possible = sum(peak * tally.lasted for peak, tally in zip(before_and_after, tallies, strict=True))
    statuses = sum((tally.statuses for tally in tallies), Counter[int]())
    goodput = statuses[200] / possible
    measured = f"{goodput:.0%}; {dict(statuses)}"
    yield Row(f"{title}: goodput relative to the peaks before and after", ">= 60 %", measured, goodput >= 0.6)
    slowest = max(looked.p99 for looked in health)
    seen = sum((Counter(looked.statuses) for looked in health), Counter[int]())
    measured, fine = f"{slowest:.0f} ms, {dict(seen)}", slowest < 250 and set(seen) == {200}
    yield Row(f"{title}: p99 of /live and /ready, the worst turn", "< 250 ms, all 200", measured, fine)


Part = Literal["start", "overhead", "load", "overload", "faults", "changes", "kills", "shares", "soak"]
PARTS: dict[Part, Callable[[Settings], Iterator[Row]]] = {
    "start": cold_start,
    "overhead": overhead,
    "load": load,
    "overload": too_much,
    "faults": faults,
    "changes": changes,
    "kills": kills,
    "shares": shares,
    "soak": soak,
}
SHORT: tuple[Part, ...] = tuple(part for part in PARTS if part not in ("shares", "soak"))
"""The parts that run unless some are named."""


def main(
    scene: Path = SCENE, only: tuple[Part, ...] = SHORT, minutes: float | None = None, overload_seconds: float = 60.0
) -> int:
    """Measure the service levels in under 5 minutes. The exit status is 1 if a bound isn't met.

    python -m benchmarks.service

    python -m benchmarks.service --only load --minutes 5

    python -m benchmarks.service --only soak

    Use an idle machine. Clients run on it too and take part of its processor time.

    Args:
        scene: A scene file whose time range is [0, 1].
        only: Run these parts, of which `shares` and `soak` take longer than all others.
        minutes: Duration of a long part: by default 0.7 for the mixed load, whose documented levels are for 5, 0.5 for
            each half of `shares`, and 30 for `soak`.
        overload_seconds: Duration of the overload.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that services are stopped too
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as work:
        folder = make_scenes(Path(work) / "scenes", scene)
        settings = Settings(scene, folder, Path(work), minutes, overload_seconds)
        for name in only:
            print(f"{name}: {(PARTS[name].__doc__ or '').splitlines()[0]}", flush=True)
            for row in PARTS[name](settings):
                rows.append(row)
                print(f"  {row.name}: {row.measured} (bound: {row.bound})", flush=True)
    return 0 if print_rows(rows) else 1


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
