"""Many clients at once, and the answers that they get.

All run in one thread with a minimal HTTP client, since they share the service's machine.
"""

import asyncio
import multiprocessing
import random
import time
from collections import Counter
from collections.abc import Coroutine, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import uvloop

from benchmarks.service.line import Line, connected
from benchmarks.service.process import Connection, Running
from benchmarks.service.requests import Wanted, digest

HEALTH_PAUSE, MEMORY_PAUSE = 0.05, 0.5  # seconds


@dataclass
class Tally:
    """The answers that clients got."""

    seconds: list[float] = field(default_factory=list)  # of accepted requests
    statuses: Counter[int] = field(default_factory=Counter)
    bodies: Counter[tuple[Wanted, str]] = field(default_factory=Counter)  # requests with the digest of the answer
    resident: list[int] = field(default_factory=list)  # bytes of the service at regular intervals
    lasted: float = 0.0

    @property
    def frames_per_second(self) -> float:
        return self.statuses[200] / self.lasted

    def milliseconds(self, part: float) -> float:
        """A quantile of the time of accepted requests."""
        return 1000 * float(np.quantile(self.seconds, part)) if self.seconds else float("nan")

    def add(self, wanted: Wanted, status: int, body: bytes, seconds: float) -> None:
        """Count one answer."""
        self.statuses[status] += 1
        if status == 200:
            self.seconds.append(seconds)
            self.bodies[wanted, digest(body)] += 1


class Health(NamedTuple):
    """Times and statuses of /live and /ready, requested in turns on new connections by a separate process."""

    p99: float  # milliseconds
    statuses: dict[int, int]


def saturate(running: Running, requests: Sequence[Wanted], clients: int, seconds: float) -> Tally:
    """Clients that send the next request as soon as they are answered, or after `Retry-After` if they are refused."""
    tally, stop = Tally(), time.monotonic() + seconds

    async def client(seed: int) -> None:
        chance = random.Random(seed)
        async with connected(running.port) as line:
            while time.monotonic() < stop:
                wait = await _ask(line, chance.choice(requests), tally)
                await asyncio.sleep(wait)

    uvloop.run(_together(running, tally, [client(seed) for seed in range(clients)]))
    return tally


def at_rate(running: Running, requests: Sequence[Wanted], clients: int, seconds: float, rate: float) -> Tally:
    """Requests at regular intervals, independent of the answers, as long as one of `clients` is free."""
    tally, begun = Tally(), time.monotonic()
    moments = iter(enumerate(np.arange(0, seconds, 1 / rate).tolist()))

    async def client() -> None:
        async with connected(running.port) as line:
            for number, moment in moments:
                await asyncio.sleep(max(0.0, begun + moment - time.monotonic()))
                await _ask(line, requests[number % len(requests)], tally)

    uvloop.run(_together(running, tally, [client() for _ in range(clients)]))
    return tally


async def _ask(line: Line, wanted: Wanted, tally: Tally) -> float:
    """Send one request; returns the seconds that its client has to wait."""
    started = time.perf_counter()
    answer = await line.post("/render", wanted.body())
    tally.add(wanted, answer.status, answer.body, time.perf_counter() - started)
    return float(answer.header("retry-after")) if answer.status == 503 else 0.0


def overload(
    running: Running, requests: Sequence[Wanted], clients: int, seconds: float, rate: float
) -> tuple[Tally, Health]:
    """`at_rate`, while another process requests the service's health."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        pool.submit(int).result()  # started before the load is
        health = pool.submit(watch_health, running.port, seconds)
        return at_rate(running, requests, clients, seconds, rate), health.result()


def watch_health(port: int, seconds: float) -> Health:
    """Request /live and /ready in turns for `seconds`."""
    took: list[float] = []
    statuses: Counter[int] = Counter()
    stop = time.monotonic() + seconds
    while time.monotonic() < stop:
        for path in ("/live", "/ready"):
            started = time.perf_counter()
            connection = Connection(port)
            statuses[connection.ask("GET", path).status] += 1
            connection.close()
            took.append(time.perf_counter() - started)
        time.sleep(HEALTH_PAUSE)
    return Health(1000 * float(np.quantile(took, 0.99)), dict(statuses))


async def _together(running: Running, tally: Tally, clients: Sequence[Coroutine[None, None, None]]) -> None:
    """Run all clients and sample the service's memory meanwhile."""
    begun = time.monotonic()
    everyone = asyncio.gather(*clients)
    while not everyone.done():
        tally.resident.append(running.resident_bytes())
        await asyncio.wait([everyone], timeout=MEMORY_PAUSE)
    tally.lasted = time.monotonic() - begun
    await everyone
