"""A trace of requests, and a simulation of replicas that answer them."""

import heapq
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

Routing = Literal["affinity", "round robin", "bounded"]

TRIES = 3  # replicas that the proxy tries, as in docker/nginx/nginx.conf
BOUND = 1.25  # `bounded`: a replica has at most this many times the mean number of requests
RETRY_SECONDS = 1.0  # that a refused client waits


class Trace(NamedTuple):
    """Scene and time of each request."""

    scenes: np.ndarray  # [N] int
    times: np.ndarray  # [N] int


class Stages(NamedTuple):
    """Seconds per frame on one core, as samples to draw from."""

    hit: np.ndarray  # the pose is cached
    miss: np.ndarray


@dataclass(frozen=True)
class Fleet:
    """Replicas of one core each."""

    replicas: int
    routing: Routing = "affinity"
    poses: int = 64  # capacity of a replica's cache
    queue: int = 16  # waiting requests of a replica


class Outcome(NamedTuple):
    """The result of a simulation."""

    latencies: np.ndarray  # [served] seconds
    refused: int
    hits: int
    seconds: float  # from the first request to the last answer
    busiest: float  # requests of the busiest replica, relative to the mean

    @property
    def hit_rate(self) -> float:
        return self.hits / max(len(self.latencies), 1)

    @property
    def rate(self) -> float:
        """Frames per second."""
        return len(self.latencies) / self.seconds


def zipf_trace(count: int, scenes: int, times: int) -> Trace:
    """Seeded requests: scenes have frequency 1 / rank, and so have the times of each scene, in a random order."""
    rng = np.random.default_rng(0)
    inverse = [1 / np.arange(1, n + 1) for n in (scenes, times)]
    scene, rank = (rng.choice(len(weights), count, p=weights / float(weights.sum())) for weights in inverse)
    orders = rng.permuted(np.tile(np.arange(times), (scenes, 1)), axis=1)
    return Trace(scene, orders[scene, rank])


class _Replica:
    def __init__(self, poses: int) -> None:
        self.free_at, self.asked, self._poses = 0.0, 0, poses
        self._ends: deque[float] = deque()  # of unanswered requests
        self._cache: OrderedDict[int, None] = OrderedDict()

    def pending(self, now: float) -> int:
        while self._ends and self._ends[0] <= now:
            self._ends.popleft()
        return len(self._ends)

    def has_pose(self, key: int) -> bool:
        """Whether the pose is cached; it is afterwards."""
        hit = key in self._cache
        self._cache[key] = None
        self._cache.move_to_end(key)
        if len(self._cache) > self._poses:
            self._cache.popitem(last=False)
        return hit

    def serve(self, now: float, seconds: float) -> float:
        """The time of the answer."""
        self.free_at = max(now, self.free_at) + seconds
        self._ends.append(self.free_at)
        self.asked += 1
        return self.free_at


def simulate(trace: Trace, fleet: Fleet, stages: Stages, *, clients: int = 0, rate: float = 0.0) -> Outcome:
    """Replay a trace with `clients` that send the next request when they are answered, or with random arrivals at
    `rate` requests per second."""
    rng, count = np.random.default_rng(0), len(trace.scenes)
    arrivals = [] if clients else np.cumsum(rng.exponential(1 / rate, count)).tolist()
    keys = trace.scenes.astype(np.uint64) * 1_000_003 + trace.times.astype(np.uint64)
    hashes = keys * np.uint64(0x9E3779B97F4A7C15)
    homes = (hashes ^ (hashes >> np.uint64(29))) % np.uint64(2**31) % np.uint64(fleet.replicas)
    hit_seconds, miss_seconds = rng.choice(stages.hit, count), rng.choice(stages.miss, count)
    replicas = [_Replica(fleet.poses) for _ in range(fleet.replicas)]
    ready = [0.0] * clients  # the times at which clients send their next request
    latencies, hits, last = [], 0, 0.0
    for number, (key, home) in enumerate(zip(keys.tolist(), homes.tolist(), strict=True)):
        now = heapq.heappop(ready) if clients else arrivals[number]
        replica = _choose(replicas, fleet, number, home, now)
        next_request = now + RETRY_SECONDS
        if replica is not None:
            hit = replica.has_pose(key)
            next_request = replica.serve(now, float((hit_seconds if hit else miss_seconds)[number]))
            last = max(last, next_request)
            hits += hit
            latencies.append(next_request - now)
        if clients:
            heapq.heappush(ready, next_request)
    asked = [replica.asked for replica in replicas]
    busiest = max(asked) / max(float(np.mean(asked)), 1e-9)
    return Outcome(np.array(latencies), count - len(latencies), hits, last, busiest)


def _choose(replicas: list[_Replica], fleet: Fleet, number: int, home: int, now: float) -> _Replica | None:
    """The first replica with a free place, in the order in which the proxy tries them."""
    first = number % len(replicas) if fleet.routing == "round robin" else home
    bounded = fleet.routing == "bounded"
    limit = BOUND * (number + 1) / len(replicas) + 1 if bounded else np.inf
    for step in range(len(replicas) if bounded else min(TRIES, len(replicas))):
        replica = replicas[(first + step) % len(replicas)]
        if replica.pending(now) <= fleet.queue and replica.asked < limit:
            return replica
    return None
