"""Numbers about the service, as Prometheus reads them."""

from collections.abc import Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, GCCollector, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from msdgs_serve.api.work import WorkQueue
from msdgs_serve.pose_cache import PoseCache
from msdgs_serve.store import SceneStore

SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Metrics:
    """Counters of one service; several may live in a process."""

    def __init__(self, store: SceneStore, cache: PoseCache, queue: WorkQueue) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "msdgs_requests", "Requests answered", ("method", "route", "status"), registry=self._registry
        )
        self._latency = Histogram(
            "msdgs_request_seconds", "From the headers to the last byte", ("route",),
            buckets=SECONDS, registry=self._registry,
        )  # fmt: skip
        self._stages = Histogram(
            "msdgs_stage_seconds", "Of a frame: queue, pose, draw, encode", ("stage",),
            buckets=SECONDS, registry=self._registry,
        )  # fmt: skip
        self._problems = Counter("msdgs_problems", "Answers that are problems", ("kind",), registry=self._registry)
        self._bytes = Counter("msdgs_sent_bytes", "Bytes of answers", ("route",), registry=self._registry)
        self._registry.register(_State(store, cache, queue))
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)

    def count_request(self, method: str, route: str, status: int, seconds: float, sent: int) -> None:
        """One request that was answered."""
        self._requests.labels(method, route, str(status)).inc()
        self._latency.labels(route).observe(seconds)
        self._bytes.labels(route).inc(sent)

    def count_problem(self, kind: str) -> None:
        """One answer that was a problem."""
        self._problems.labels(kind).inc()

    def count_stages(self, seconds: Mapping[str, float]) -> None:
        """The stages of one frame."""
        for stage, duration in seconds.items():
            self._stages.labels(stage).observe(duration)

    def page(self) -> bytes:
        """All of it, in Prometheus' text format."""
        return generate_latest(self._registry)


class _State(Collector):
    """What is read when it is asked for."""

    def __init__(self, store: SceneStore, cache: PoseCache, queue: WorkQueue) -> None:
        self._store, self._cache, self._queue = store, cache, queue

    def collect(self) -> Iterable[Metric]:
        yield GaugeMetricFamily("msdgs_queue_waiting", "Renders in line", self._queue.waiting)
        yield GaugeMetricFamily("msdgs_renders_running", "Renders in work", self._queue.running)
        use = self._cache.use
        yield GaugeMetricFamily("msdgs_pose_cache_bytes", "Posed Gaussians kept", use.bytes)
        yield GaugeMetricFamily("msdgs_pose_cache_poses", "Poses kept", use.poses)
        lookups = CounterMetricFamily("msdgs_pose_cache_lookups", "Poses asked for", labels=("result",))
        lookups.add_metric(("hit",), use.hits)
        lookups.add_metric(("miss",), use.misses)
        yield lookups
        statuses = self._store.statuses()
        scenes = GaugeMetricFamily("msdgs_scenes", "Scenes by state", labels=("state",))
        scenes.add_metric(("known",), len(statuses))
        scenes.add_metric(("loaded",), sum(status.loaded for status in statuses))
        scenes.add_metric(("broken",), sum(status.problem is not None for status in statuses))
        yield scenes
