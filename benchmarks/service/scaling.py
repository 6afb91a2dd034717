"""What one core serves, and what many would."""

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

from benchmarks.measuring import machine
from benchmarks.service.process import Connection, Running, service
from benchmarks.service.simulation import Fleet, Routing, Stages, Trace, simulate, zipf_trace
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import SceneMetadata

SCENES, TIMES = 8, 64  # of the trace that is measured
IN_TURN = 25  # frames
MIN_PSNR = 0.15
LOAD = 0.7  # of what all cores could draw without any cache
CATALOGUE, MOMENTS = 200, 300  # scenes and times of a large service
LARGE_CACHE = 256  # megabytes
CORE_HOUR = 0.04  # dollars: an assumption, of rented x86 cores


@dataclass(frozen=True)
class Scaling:
    """Replay a trace of requests, scenes and times with frequency 1 / rank, against services of one core each, and
    simulate the same.

    python -m benchmarks.service.scaling examples/toybench.onnx

    Seconds per frame are those of one client, and in turns with it four clients at another such service give a rate.
    The simulation has to reproduce that rate within 15 %, or nothing is extrapolated and the exit status is 1; then
    comes a table up to a thousand replicas.
    """

    scene: Annotated[Path, tyro.conf.Positional] = Path("examples/toybench.onnx")
    size: int = 400
    """Pixels a side."""
    frames: int = 600
    """Frames of each measurement."""
    repeats: int = 3
    """Turns; the least disturbed counts."""
    clients: int = 4
    cache_megabytes: int = 32
    requests: int = 100_000
    """Requests that are simulated."""
    replicas: tuple[int, ...] = (1, 3, 10, 30, 100, 300, 1000)
    """Numbers of replicas that are simulated."""
    check: bool = False
    """Only see that this benchmark works: laws of the simulation, a small measurement."""


class Frame(NamedTuple):
    """One answer."""

    seconds: float
    hit: bool
    size: int  # bytes


class Measured(NamedTuple):
    """One turn."""

    stages: Stages
    rate: float  # frames a second of several clients
    hit_rate: float
    frame_bytes: float


def replay(port: int, scene: SceneMetadata, trace: Trace, numbers: range, size: int, clients: int = 1) -> list[Frame]:
    """Ask for these frames of the trace, which clients share."""
    own = threading.local()
    first, last = scene.time_range

    def ask(number: int) -> Frame:
        if not hasattr(own, "connection"):
            own.connection = Connection(port)
        t = first + (last - first) * int(trace.times[number]) / TIMES
        camera = {"type": "orbit", "azimuth": 37 * number % 360, "elevation": 20}
        body = {"scene": f"scene{int(trace.scenes[number])}", "camera": camera, "t": t, "format": "jpeg"}
        started = time.perf_counter()
        answer = own.connection.ask("POST", "/render", {**body, "width": size, "height": size})
        if answer.status != 200:
            raise SystemExit(f"the service answered {answer.status}: {answer.body[:200]!r}")
        seconds = time.perf_counter() - started
        return Frame(seconds, "miss" not in answer.headers["server-timing"], len(answer.body))

    with ThreadPoolExecutor(clients) as pool:
        return list(pool.map(ask, numbers))


class Bench:
    """A core, over one scene under several names, and its simulation."""

    def __init__(self, options: Scaling, folder: Path) -> None:
        session = DeformationSession(options.scene)
        self.options, self._folder, self._scene = options, folder, session.scene.metadata
        self._pose_bytes = 40 * (session.scene.moving_count + len(session.scene.static_means))
        self._poses = max(1, (options.cache_megabytes << 20) // self._pose_bytes)
        self._trace = zipf_trace(options.frames, SCENES, TIMES)
        self._copies = folder / "scenes"
        self._copies.mkdir()
        for number in range(SCENES):
            shutil.copyfile(options.scene, self._copies / f"scene{number}.onnx")

    def run(self) -> int:
        """Measure, calibrate, extrapolate."""
        cores = os.sched_getaffinity(0)
        turns = [self._turn(sorted(cores)) for _ in range(self.options.repeats)]
        os.sched_setaffinity(0, cores)
        best = max(turns, key=lambda turn: turn.rate)  # disturbed least
        simulated = simulate(self._trace, Fleet(1, poses=self._poses), best.stages, clients=self.options.clients)
        hit, miss = (1e3 * stage.mean() for stage in best.stages)
        error = simulated.rate / best.rate - 1
        print(f"one core, JPEG; {self._poses} poses of {self._pose_bytes / 1e6:.2f} MB fit")
        print(f"a frame: {hit:.1f} ms if it is posed already, {miss:.1f} ms if not")
        print(f"measured {best.rate:.1f} frames a second, hit rate {best.hit_rate:.2f}")
        print(f"simulated {simulated.rate:.1f} frames a second, hit rate {simulated.hit_rate:.2f}: {error:+.1%}")
        if abs(error) > MIN_PSNR:
            print("the simulation doesn't reproduce what was measured; nothing is extrapolated", file=sys.stderr)
            return 1
        self.extrapolate(best)
        return 0

    def _turn(self, cores: list[int]) -> Measured:
        """A few frames of one client, then of several, and so on, so that what else runs disturbs both alike. Services
        are on one core, clients on another."""
        alone, together, spent, clients = list[Frame](), list[Frame](), 0.0, self.options.clients
        os.sched_setaffinity(0, {cores[0]})
        with self._service() as one, self._service() as other:
            os.sched_setaffinity(0, {cores[-1]})
            for start in range(0, self.options.frames, IN_TURN):
                numbers = range(start, min(start + IN_TURN, self.options.frames))
                alone += replay(one.port, self._scene, self._trace, numbers, self.options.size)
                started = time.perf_counter()
                together += replay(other.port, self._scene, self._trace, numbers, self.options.size, clients)
                spent += time.perf_counter() - started
        hits, misses = ([f.seconds for f in alone if f.hit == hit] for hit in (True, False))
        stages = Stages(np.array(hits), np.array(misses))
        rate, hit_rate = self.options.frames / spent, float(np.mean([f.hit for f in together]))
        return Measured(stages, rate, hit_rate, float(np.mean([f.size for f in alone])))

    @contextmanager
    def _service(self) -> Iterator[Running]:
        """One thread; all scenes are open, kernels are loaded."""
        flags = {"threads": 1, "concurrent_renders": 1, "queued_renders": 64}
        with service(self._copies, cache_megabytes=self.options.cache_megabytes, **flags) as running:
            opening = Trace(np.arange(SCENES), np.full(SCENES, TIMES))
            replay(running.port, self._scene, opening, range(SCENES), self.options.size)
            yield running

    def extrapolate(self, measured: Measured) -> None:
        """A table from one core to a thousand."""
        trace, stages = zipf_trace(self.options.requests, CATALOGUE, MOMENTS), measured.stages
        fleet = Fleet(1, poses=max(1, (LARGE_CACHE << 20) // self._pose_bytes))
        print(f"\n{CATALOGUE} scenes × {MOMENTS} times, 1/rank; {fleet.poses} poses a replica; {LOAD:.0%} load")
        print("replicas | routing | hits | frames/s | refused | p50 ms | p99 ms | busiest/mean | Mbit/s | $ a million")
        routings: tuple[Routing, ...] = ("round robin", "affinity", "bounded")
        for count, routing in ((count, routing) for count in self.options.replicas for routing in routings):
            rate = LOAD * count / float(stages.miss.mean())
            found = simulate(trace, replace(fleet, replicas=count, routing=routing), stages, rate=rate)
            p50, p99 = 1e3 * np.quantile(found.latencies, [0.5, 0.99])
            megabits, dollars = found.rate * measured.frame_bytes * 8e-6, count * CORE_HOUR / 3.6e-3 / found.rate
            print(
                f"{count} | {routing} | {found.hit_rate:.2f} | {found.rate:.0f} | "
                f"{found.refused / len(trace.scenes):.1%} | {p50:.0f} | {p99:.0f} | {found.busiest:.2f} | "
                f"{megabits:.0f} | {dollars:.2f}"
            )
        one, three = (simulate(trace, replace(fleet, replicas=n), stages, clients=12 * n).rate for n in (1, 3))
        print(f"three replicas by affinity, all that they can take: {three / one:.2f} × one")


def main(options: Scaling) -> int:
    """Measure, calibrate, extrapolate."""
    if options.check:
        return check()
    print(f"{machine()}; {options.scene.name}, {options.size} × {options.size}, {options.frames} frames")
    with tempfile.TemporaryDirectory() as folder:
        return Bench(options, Path(folder)).run()


def check() -> int:
    """A cache that holds all misses once per pose; affinity adds caches up; a full queue refuses. Then a small run."""
    trace, one = zipf_trace(2000, SCENES, TIMES), Stages(np.array([0.01]), np.array([0.02]))
    distinct = len(set(zip(*(column.tolist() for column in trace), strict=True)))
    alone = simulate(trace, Fleet(1, poses=SCENES * TIMES), one, clients=1)
    assert (alone.hits, alone.refused) == (2000 - distinct, 0)
    assert abs(alone.seconds - 0.01 * (2000 + distinct)) < 1e-6
    affinity, turns = (simulate(trace, Fleet(3, r, poses=40), one, clients=6) for r in ("affinity", "round robin"))
    assert affinity.hit_rate > turns.hit_rate
    flooded = simulate(trace, Fleet(1, poses=40), one, rate=500)
    assert flooded.refused > 500
    assert flooded.latencies.max() <= 17 * 0.02 + 1e-9
    small = Scaling(size=32, frames=40, repeats=1, requests=500, replicas=(1, 3))
    with tempfile.TemporaryDirectory() as folder:
        Bench(small, Path(folder)).extrapolate(Measured(one, 100.0, 0.5, 1e4))
    assert main(small) in (0, 1)  # on a busy machine the simulation may miss the rate
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Scaling)))
