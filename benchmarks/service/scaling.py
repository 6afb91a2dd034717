"""Frames per second of one core, and a simulation of many."""

import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro

from benchmarks.measuring import machine, report_console, table
from benchmarks.service.levels import SCENE
from benchmarks.service.process import Connection, Running, service
from benchmarks.service.simulation import Fleet, Routing, Stages, Trace, simulate, zipf_trace
from msdgs_serve.deformation import DeformationSession

SCENES, TIMES = 8, 64  # of the measured trace
FRAMES_PER_TURN = 25
MAX_RATE_ERROR = 0.15
LOAD = 0.7  # of the rate of all cores without a cache
CATALOGUE, CATALOGUE_TIMES = 200, 300  # scenes and times of a large service
LARGE_CACHE = 256  # megabytes
CORE_HOUR = 0.04  # dollars: an assumption, of rented x86 cores
ROUTINGS: tuple[Routing, ...] = ("round robin", "affinity", "bounded")


@dataclass(frozen=True)
class Scaling:
    """Replay a trace of requests, scenes and times with frequency 1 / rank, on services of one core each, and simulate
    the same trace.

    python -m benchmarks.service.scaling examples/toys.onnx

    Seconds per frame are those of one client; in turns with it, four clients of another such service give a rate. If
    the simulation is off by more than 15 % of this rate, nothing is extrapolated and the exit status is 1. Otherwise a
    table up to a thousand replicas follows.
    """

    scene: Annotated[Path, tyro.conf.Positional] = SCENE
    """A scene file whose time range is [0, 1]."""
    size: int = 400
    """Width and height in pixels."""
    frames: int = 600
    """Frames of each measurement."""
    repeats: int = 3
    """Repeats, of which the fastest counts."""
    clients: int = 4
    cache_megabytes: int = 32
    requests: int = 100_000
    """Simulated requests."""
    replicas: tuple[int, ...] = (1, 3, 10, 30, 100, 300, 1000)
    """Simulated numbers of replicas."""
    check: bool = False
    """Test this benchmark: laws of the simulation and a small measurement."""


class Frame(NamedTuple):
    """One answer."""

    seconds: float
    hit: bool
    size: int  # bytes


class Measured(NamedTuple):
    """One repeat of the measurement."""

    stages: Stages
    rate: float  # frames per second of several clients
    hit_rate: float
    frame_bytes: float


def replay(port: int, trace: Trace, numbers: range, size: int, clients: int = 1) -> list[Frame]:
    """Request these frames of the trace with several clients."""
    own = threading.local()

    def ask(number: int) -> Frame:
        if not hasattr(own, "connection"):
            own.connection = Connection(port)
        camera = {"type": "orbit", "azimuth": 37 * number % 360, "elevation": 20}
        scene, t = f"scene{int(trace.scenes[number])}", int(trace.times[number]) / TIMES
        body = {"scene": scene, "camera": camera, "t": t, "format": "jpeg", "width": size, "height": size}
        started = time.perf_counter()
        answer = own.connection.ask("POST", "/render", body)
        if answer.status != 200:
            raise SystemExit(f"the service answered {answer.status}: {answer.body[:200]!r}")
        seconds = time.perf_counter() - started
        return Frame(seconds, "miss" not in answer.headers["server-timing"], len(answer.body))

    with ThreadPoolExecutor(clients) as pool:
        return list(pool.map(ask, numbers))


@contextmanager
def one_core_service(options: Scaling, scenes: Path) -> Iterator[Running]:
    """A service of one thread with all scenes open and kernels loaded."""
    flags = {"threads": 1, "concurrent_renders": 1, "queued_renders": 64, "cache_megabytes": options.cache_megabytes}
    with service(scenes, **flags) as running:
        opening = Trace(np.arange(SCENES), np.full(SCENES, TIMES))
        replay(running.port, opening, range(SCENES), options.size)
        yield running


def measure(options: Scaling, trace: Trace, scenes: Path) -> Measured:
    """A few frames of one client, then of several, and so on, so that other load affects both alike. Services run on
    one core, clients on another."""
    alone, together, spent, cores = list[Frame](), list[Frame](), 0.0, os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    with one_core_service(options, scenes) as one, one_core_service(options, scenes) as other:
        os.sched_setaffinity(0, {max(cores)})
        for start in range(0, options.frames, FRAMES_PER_TURN):
            numbers = range(start, min(start + FRAMES_PER_TURN, options.frames))
            alone += replay(one.port, trace, numbers, options.size)
            started = time.perf_counter()
            together += replay(other.port, trace, numbers, options.size, options.clients)
            spent += time.perf_counter() - started
    os.sched_setaffinity(0, cores)
    hits, misses = ([f.seconds for f in alone if f.hit == hit] for hit in (True, False))
    rate, hit_rate = options.frames / spent, float(np.mean([f.hit for f in together]))
    return Measured(Stages(np.array(hits), np.array(misses)), rate, hit_rate, float(np.mean([f.size for f in alone])))


def extrapolate(options: Scaling, measured: Measured, pose_bytes: int) -> None:
    """Print a table from one core to a thousand."""
    trace, stages = zipf_trace(options.requests, CATALOGUE, CATALOGUE_TIMES), measured.stages
    fleet = Fleet(1, poses=max(1, (LARGE_CACHE << 20) // pose_bytes))
    made = table(
        f"{CATALOGUE} scenes × {CATALOGUE_TIMES} times, 1/rank; {fleet.poses} poses a replica; {LOAD:.0%} load",
        *("replicas", "routing", "hits", "frames/s", "refused", "p50 ms", "p99 ms", "busiest/mean", "Mbit/s"),
        "$ a million",
    )
    for count, routing in ((count, routing) for count in options.replicas for routing in ROUTINGS):
        rate = LOAD * count / float(stages.miss.mean())
        found = simulate(trace, replace(fleet, replicas=count, routing=routing), stages, rate=rate)
        p50, p99 = 1e3 * np.quantile(found.latencies, [0.5, 0.99])
        megabits, dollars = found.rate * measured.frame_bytes * 8e-6, count * CORE_HOUR / 3.6e-3 / found.rate
        cells = f"{found.hit_rate:.2f}", f"{found.rate:.0f}", f"{found.refused / len(trace.scenes):.1%}"
        times = f"{p50:.0f}", f"{p99:.0f}", f"{found.busiest:.2f}"
        made.add_row(str(count), routing, *cells, *times, f"{megabits:.0f}", f"{dollars:.2f}")
    report_console().print(made)
    one, three = (simulate(trace, replace(fleet, replicas=n), stages, clients=12 * n).rate for n in (1, 3))
    print(f"three replicas by affinity at full load: {three / one:.2f} times the rate of one")


def main(options: Scaling) -> int:
    """Measure, compare with the simulation, extrapolate."""
    if options.check:
        return check()
    print(f"{machine()}; {options.scene.name}, {options.size} × {options.size}, {options.frames} frames")
    trace = zipf_trace(options.frames, SCENES, TIMES)
    return report(options, trace, fastest(options, trace))


def fastest(options: Scaling, trace: Trace) -> Measured:
    """The repeat of the highest rate."""
    with tempfile.TemporaryDirectory() as folder:
        for number in range(SCENES):
            shutil.copyfile(options.scene, Path(folder) / f"scene{number}.onnx")
        return max((measure(options, trace, Path(folder)) for _ in range(options.repeats)), key=lambda m: m.rate)


def report(options: Scaling, trace: Trace, measured: Measured) -> int:
    """Compare a measurement with the simulation, and extrapolate if they agree."""
    pose_bytes = 40 * len(DeformationSession(options.scene).scene)
    poses = max(1, (options.cache_megabytes << 20) // pose_bytes)
    simulated = simulate(trace, Fleet(1, poses=poses), measured.stages, clients=options.clients)
    hit, miss = (1e3 * stage.mean() for stage in measured.stages)
    error = simulated.rate / measured.rate - 1
    print(f"one core, JPEG; the cache holds {poses} poses of {pose_bytes / 1e6:.2f} MB")
    print(f"a frame: {hit:.1f} ms with a cached pose, {miss:.1f} ms without")
    print(f"measured {measured.rate:.1f} frames a second, hit rate {measured.hit_rate:.2f}")
    print(f"simulated {simulated.rate:.1f} frames a second, hit rate {simulated.hit_rate:.2f}: {error:+.1%}")
    if abs(error) > MAX_RATE_ERROR:
        print("the simulation differs too much from the measurement; nothing is extrapolated", file=sys.stderr)
        return 1
    extrapolate(options, measured, pose_bytes)
    return 0


def distinct_poses(trace: Trace) -> int:
    """Scenes at times of a trace."""
    return len(set(zip(*(column.tolist() for column in trace), strict=True)))


def check() -> int:
    """A cache that holds all misses once per pose, affinity adds caches up, a full queue refuses; then a small run."""
    trace, one = zipf_trace(2000, SCENES, TIMES), Stages(np.array([0.01]), np.array([0.02]))
    distinct = distinct_poses(trace)
    alone = simulate(trace, Fleet(1, poses=SCENES * TIMES), one, clients=1)
    assert (alone.hits, alone.refused) == (2000 - distinct, 0)
    assert abs(alone.seconds - 0.01 * (2000 + distinct)) < 1e-6
    affinity, round_robin = (
        simulate(trace, Fleet(3, r, poses=40), one, clients=6) for r in ("affinity", "round robin")
    )
    assert affinity.hit_rate > round_robin.hit_rate
    flooded = simulate(trace, Fleet(1, poses=40), one, rate=500)
    assert flooded.refused > 500
    assert flooded.latencies.max() <= 17 * 0.02 + 1e-9
    small = Scaling(size=32, frames=40, repeats=1, requests=500, replicas=(1, 3))
    extrapolate(small, Measured(one, 100.0, 0.5, 1e4), pose_bytes=400_000)
    trace = zipf_trace(small.frames, SCENES, TIMES)
    found = fastest(small, trace)
    assert distinct_poses(trace) <= len(found.stages.miss) < small.frames  # each pose is computed, and some stay
    assert min(found.rate, found.frame_bytes, *found.stages.hit, *found.stages.miss) > 0
    report(small, trace, found)  # on a busy machine the simulated rate may differ
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Scaling)))
