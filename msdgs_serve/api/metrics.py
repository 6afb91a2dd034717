"""Metrics of the service for Prometheus."""

from collections.abc import Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, GCCollector, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from msdgs_serve.api.work import WorkQueue
from msdgs_serve.rasterizer.scratch import unused_bytes
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore

SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Metrics:
    """Metrics of one service, with a registry of its own."""

    def __init__(self, store: SceneStore, renderer: Renderer, queue: WorkQueue) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "msdgs_requests", "Requests answered", ("method", "route", "status"), registry=self._registry
        )
        duration = "Time from the headers of a request to the last byte of its response"
        self._latency = Histogram(
            "msdgs_request_seconds", duration, ("route", "status"), buckets=SECONDS, registry=self._registry
        )
        self._stages = Histogram(
            "msdgs_stage_seconds", "Time of the stages of a frame: queue, pose, draw, encode", ("stage",),
            buckets=SECONDS, registry=self._registry,
        )  # fmt: skip
        problems = "Responses that are problems or were cut off"
        self._problems = Counter("msdgs_problems", problems, ("kind",), registry=self._registry)
        self._bytes = Counter("msdgs_sent_bytes", "Bytes of response bodies", ("route",), registry=self._registry)
        self._registry.register(_State(store, renderer, queue))
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)

    def count_request(self, method: str, route: str, status: int, seconds: float, sent: int) -> None:
        """Count an answered request."""
        self._requests.labels(method, route, str(status)).inc()
        self._latency.labels(route, str(status)).observe(seconds)
        self._bytes.labels(route).inc(sent)

    def count_problem(self, kind: str) -> None:
        """Count a response that is a problem."""
        self._problems.labels(kind).inc()

    def count_stages(self, seconds: Mapping[str, float]) -> None:
        """Count the stages of a frame."""
        for stage, duration in seconds.items():
            self._stages.labels(stage).observe(duration)

    def page(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        return generate_latest(self._registry)


class _State(Collector):
    """Metrics that are read when they are requested."""

    def __init__(self, store: SceneStore, renderer: Renderer, queue: WorkQueue) -> None:
        self._store, self._renderer, self._queue = store, renderer, queue

    def collect(self) -> Iterable[Metric]:
        yield GaugeMetricFamily("msdgs_queue_waiting", "Renders that wait in the queue", self._queue.waiting)
        yield GaugeMetricFamily("msdgs_renders_running", "Renders in progress", self._queue.running)
        use = self._renderer.cache.use
        yield GaugeMetricFamily("msdgs_pose_cache_bytes", "Memory of cached poses", use.bytes)
        yield GaugeMetricFamily("msdgs_pose_cache_poses", "Cached poses", use.poses)
        lookups = CounterMetricFamily("msdgs_pose_cache_lookups", "Lookups in the pose cache", labels=("result",))
        lookups.add_metric(("hit",), use.hits)
        lookups.add_metric(("miss",), use.misses)
        yield lookups
        kept = self._renderer.sequences.use
        yield GaugeMetricFamily("msdgs_sequence_cache_bytes", "Memory of what stands still before cameras", kept.bytes)
        yield GaugeMetricFamily("msdgs_sequence_cache_sequences", "Cameras that keep what stands still", kept.sequences)
        frames = CounterMetricFamily("msdgs_sequence_cache_frames", "Frames by how they are drawn", labels=("drawn",))
        frames.add_metric(("moving",), kept.drawn)
        frames.add_metric(("whole",), kept.whole)
        yield frames
        yield GaugeMetricFamily("msdgs_scratch_bytes", "Memory kept for arrays of the next frames", unused_bytes())
        statuses = self._store.statuses()
        scenes = GaugeMetricFamily("msdgs_scenes", "Scenes by state", labels=("state",))
        scenes.add_metric(("known",), len(statuses))
        scenes.add_metric(("loaded",), sum(status.loaded for status in statuses))
        scenes.add_metric(("broken",), sum(status.problem is not None for status in statuses))
        yield scenes
