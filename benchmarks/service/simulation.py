"""Requests as many people send them, and a simulation of replicas that answer them."""

import heapq
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

Routing = Literal["affinity", "round robin", "bounded"]

TRIES = 3  # replicas that the proxy asks, as docker/nginx/nginx.conf says
BOUND = 1.25  # `bounded`: a replica has at most this many times the mean of requests


class Trace(NamedTuple):
    """Which scene and time each request asks for."""

    scenes: np.ndarray  # [N] int
    times: np.ndarray  # [N] int, of so many moments


@dataclass(frozen=True)
class Stages:
    """Seconds that one core needs for a frame, as samples to draw from."""

    hit: np.ndarray  # where its pose is in the cache
    miss: np.ndarray


@dataclass(frozen=True)
class Fleet:
    """What answers."""

    replicas: int
    routing: Routing = "affinity"
    workers: int = 1  # frames at once, of a core each
    poses: int = 64  # that a replica's cache holds
    queue: int = 16  # places for waiting


class Outcome(NamedTuple):
    """Of a simulation."""

    served: int
    refused: int
    hits: int
    seconds: float  # from the first request to the last answer
    latencies: np.ndarray  # [served] seconds
    busiest: float  # requests of the busiest replica, against the mean

    @property
    def hit_rate(self) -> float:
        return self.hits / max(self.served, 1)

    @property
    def rate(self) -> float:
        """Frames a second."""
        return self.served / self.seconds


def heavy_tailed(count: int, scenes: int, times: int, seed: int = 0, exponent: float = 1.0) -> Trace:
    """Scenes, and the moments of each in an order of its own, asked for with frequency 1 / rank ** exponent."""
    chance = np.random.default_rng(seed)
    scene = chance.choice(scenes, count, p=_zipf(scenes, exponent))
    rank = chance.choice(times, count, p=_zipf(times, exponent))
    orders = chance.permuted(np.tile(np.arange(times), (scenes, 1)), axis=1)
    return Trace(scene, orders[scene, rank])


def _zipf(count: int, exponent: float) -> np.ndarray:
    weights = 1 / np.arange(1, count + 1) ** exponent
    return weights / weights.sum()


def simulate_clients(trace: Trace, fleet: Fleet, stages: Stages, clients: int, seed: int = 0) -> Outcome:
    """Clients that ask for the next frame of the trace as soon as they have one."""
    return _simulate(trace, fleet, stages, None, clients, seed)


def simulate_arrivals(trace: Trace, fleet: Fleet, stages: Stages, rate: float, seed: int = 0) -> Outcome:
    """Requests that come by themselves, `rate` a second, at random moments."""
    gaps = np.random.default_rng(seed + 1).exponential(1 / rate, len(trace.scenes))
    return _simulate(trace, fleet, stages, np.cumsum(gaps), 0, seed)


class _Replica:
    def __init__(self, fleet: Fleet) -> None:
        self.free = [0.0] * fleet.workers  # when each worker has ended what it was given
        self.ends: list[float] = []  # of all that isn't answered yet
        self.cache: OrderedDict[int, None] = OrderedDict()
        self.asked = 0

    def waiting(self, now: float) -> int:
        while self.ends and self.ends[0] <= now:
            heapq.heappop(self.ends)
        return len(self.ends)


def _simulate(
    trace: Trace, fleet: Fleet, stages: Stages, arrivals: np.ndarray | None, clients: int, seed: int
) -> Outcome:
    chance = np.random.default_rng(seed)
    count = len(trace.scenes)
    keys = trace.scenes.astype(np.int64) * 1_000_003 + trace.times
    homes = _spread(keys) % fleet.replicas
    hit_seconds, miss_seconds = chance.choice(stages.hit, count), chance.choice(stages.miss, count)
    replicas = [_Replica(fleet) for _ in range(fleet.replicas)]
    ready = [0.0] * clients  # when each client asks next
    latencies, hits, refused, last = [], 0, 0, 0.0
    for number, key in enumerate(keys.tolist()):
        now = heapq.heappop(ready) if arrivals is None else float(arrivals[number])
        replica = _choose(replicas, fleet, number, int(homes[number]), now)
        if replica is None:
            refused += 1
            if arrivals is None:
                heapq.heappush(ready, now + 1.0)
            continue
        hit = key in replica.cache
        replica.cache[key] = None
        replica.cache.move_to_end(key)
        if len(replica.cache) > fleet.poses:
            replica.cache.popitem(last=False)
        begin = max(now, heapq.heappop(replica.free))
        end = begin + float((hit_seconds if hit else miss_seconds)[number])
        heapq.heappush(replica.free, end)
        heapq.heappush(replica.ends, end)
        replica.asked += 1
        hits += hit
        last = max(last, end)
        latencies.append(end - now)
        if arrivals is None:
            heapq.heappush(ready, end)
    asked = [replica.asked for replica in replicas]
    busiest = max(asked) / max(float(np.mean(asked)), 1e-9)
    return Outcome(count - refused, refused, hits, last, np.array(latencies), busiest)


def _choose(replicas: Sequence[_Replica], fleet: Fleet, number: int, home: int, now: float) -> _Replica | None:
    """The first in turn that has a place, as the proxy sends requests on that were refused."""
    first = number % len(replicas) if fleet.routing == "round robin" else home
    tries = len(replicas) if fleet.routing == "bounded" else min(TRIES, len(replicas))
    limit = BOUND * (number + 1) / len(replicas) + 1 if fleet.routing == "bounded" else np.inf
    for step in range(tries):
        replica = replicas[(first + step) % len(replicas)]
        if replica.waiting(now) < fleet.workers + fleet.queue and replica.asked < limit:
            return replica
    return None


def _spread(keys: np.ndarray) -> np.ndarray:
    """A hash, [N] of [N]."""
    mixed = keys.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return ((mixed ^ (mixed >> np.uint64(29))) % np.uint64(2**31)).astype(np.int64)
