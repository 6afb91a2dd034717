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
RETRY_SECONDS = 1.0  # that a refused client waits


class Trace(NamedTuple):
    """Which scene and time each request asks for."""

    scenes: np.ndarray  # [N] int
    times: np.ndarray  # [N] int


class Stages(NamedTuple):
    """Seconds that one core needs per frame, as samples to draw from."""

    hit: np.ndarray  # its pose is in the cache
    miss: np.ndarray


@dataclass(frozen=True)
class Fleet:
    """Replicas of one core each."""

    replicas: int
    routing: Routing = "affinity"
    poses: int = 64  # that a replica's cache holds
    queue: int = 16  # places for waiting


class Outcome(NamedTuple):
    """What a simulation says."""

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


def zipf_trace(count: int, scenes: int, times: int, seed: int = 0) -> Trace:
    """Scenes, and the times of each in an order of its own, asked for with frequency 1 / rank."""
    rng = np.random.default_rng(seed)
    scene, rank = (rng.choice(n, count, p=1 / np.arange(1, n + 1) / _harmonic(n)) for n in (scenes, times))
    orders = rng.permuted(np.tile(np.arange(times), (scenes, 1)), axis=1)
    return Trace(scene, orders[scene, rank])


def _harmonic(count: int) -> float:
    return float((1 / np.arange(1, count + 1)).sum())


class _Replica:
    def __init__(self, poses: int) -> None:
        self.free_at, self.asked, self._poses = 0.0, 0, poses
        self._ends: list[float] = []  # of all that isn't answered yet
        self._cache: OrderedDict[int, None] = OrderedDict()

    def pending(self, now: float) -> int:
        while self._ends and self._ends[0] <= now:
            heapq.heappop(self._ends)
        return len(self._ends)

    def has_pose(self, key: int) -> bool:
        """It has it afterwards."""
        hit = key in self._cache
        self._cache[key] = None
        self._cache.move_to_end(key)
        if len(self._cache) > self._poses:
            self._cache.popitem(last=False)
        return hit

    def serve(self, now: float, seconds: float) -> float:
        """When the answer is there."""
        self.free_at = max(now, self.free_at) + seconds
        heapq.heappush(self._ends, self.free_at)
        self.asked += 1
        return self.free_at


def simulate(
    trace: Trace, fleet: Fleet, stages: Stages, *, clients: int = 0, rate: float = 0.0, seed: int = 0
) -> Outcome:
    """`clients` that ask for the next frame of the trace as soon as they have one, or requests that come at random
    moments, `rate` a second."""
    rng, count = np.random.default_rng(seed), len(trace.scenes)
    arrivals = [] if clients else np.cumsum(rng.exponential(1 / rate, count)).tolist()
    keys = trace.scenes.astype(np.int64) * 1_000_003 + trace.times
    homes = _hashed(keys) % fleet.replicas
    hit_seconds, miss_seconds = rng.choice(stages.hit, count), rng.choice(stages.miss, count)
    replicas = [_Replica(fleet.poses) for _ in range(fleet.replicas)]
    ready = [0.0] * clients  # when each client asks next
    latencies, hits, last = [], 0, 0.0
    for number, key in enumerate(keys.tolist()):
        now = heapq.heappop(ready) if clients else arrivals[number]
        replica = _choose(replicas, fleet, number, int(homes[number]), now)
        next_ask = now + RETRY_SECONDS
        if replica is not None:
            hit = replica.has_pose(key)
            next_ask = replica.serve(now, float((hit_seconds if hit else miss_seconds)[number]))
            hits += hit
            last = max(last, next_ask)
            latencies.append(next_ask - now)
        if clients:
            heapq.heappush(ready, next_ask)
    asked = [replica.asked for replica in replicas]
    busiest = max(asked) / max(float(np.mean(asked)), 1e-9)
    return Outcome(len(latencies), count - len(latencies), hits, last, np.array(latencies), busiest)


def _choose(replicas: Sequence[_Replica], fleet: Fleet, number: int, home: int, now: float) -> _Replica | None:
    """The first in turn that has a place, as the proxy sends requests on that were refused."""
    first = number % len(replicas) if fleet.routing == "round robin" else home
    bounded = fleet.routing == "bounded"
    limit = BOUND * (number + 1) / len(replicas) + 1 if bounded else np.inf
    for step in range(len(replicas) if bounded else min(TRIES, len(replicas))):
        replica = replicas[(first + step) % len(replicas)]
        if replica.pending(now) <= fleet.queue and replica.asked < limit:
            return replica
    return None


def _hashed(keys: np.ndarray) -> np.ndarray:
    """[N] of [N]."""
    mixed = keys.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return ((mixed ^ (mixed >> np.uint64(29))) % np.uint64(2**31)).astype(np.int64)
