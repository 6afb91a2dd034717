"""Shares of the queue, and a long mixed load on two services behind nginx with the settings of docker/."""

import base64
import io
import json
import multiprocessing
import os
import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import av
import numpy as np
import onnx

from benchmarks.service.levels import Row, Settings, memory_row
from benchmarks.service.load import watch_health
from benchmarks.service.process import Answer, Connection, Running, service
from benchmarks.service.requests import Offline, Wanted, digest, images, mixed
from tests.support.proxied_replicas import running_nginx
from tests.support.scene_files import write_scene

CLIENTS, NEIGHBORS = 16, 8
CATALOGUE, BATCH, BATCH_BESIDE, VIDEO_FRAMES = 48, 12, 200, 8
COLORS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SHARES_MINUTES, SOAK_MINUTES = 0.5, 30.0  # the first: of each half
MAX_WAIT = 5.0
MAX_VIDEO_DIFFERENCE = 1.0  # mean difference of two videos of the same frames, of 255
SAMPLE_SECONDS = 1.0
HOSTILE_BODIES = (
    b'{"camera": ' + b"[" * 50_000,
    b'{"t": ' + b"9" * 400 + b', "camera": {"type": "orbit", "azimuth": 0, "elevation": 0}}',
    b'{"t": 1e999, "camera": {"type": "orbit", "azimuth": NaN, "elevation": 0}, "width": -1}',
    b"\xff\xfe" * 100,
)


def key(number: int) -> str:
    """The API key of a client."""
    return f"client-{number:02d}-0123456789"


@contextmanager
def services(folder: Path, work: Path, count: int, **flags: Any) -> Iterator[list[Running]]:
    """`count` services over one folder, with a key for each client."""
    keys = work / "keys"
    keys.write_text("".join(f"read,write {key(number)}\n" for number in range(CLIENTS)))
    with ExitStack() as stack:
        yield [stack.enter_context(service(folder, api_keys_file=keys, **flags)) for _ in range(count)]


class Client:
    """A client with a key and a connection of its own."""

    def __init__(self, number: int, port: int) -> None:
        self.number = number
        self.statuses: Counter[int] = Counter()
        self._headers = {"Content-Type": "application/json", "X-API-Key": key(number)}
        self._connection = Connection(port)

    def ask(self, method: str, path: str, content: bytes | None = None) -> Answer:
        """The answer; if the service is full, the request is repeated after the time that it names."""
        while True:
            answer = self._connection.send(method, path, content, self._headers)
            self.statuses[answer.status] += 1
            if answer.status != 503:
                return answer
            time.sleep(min(float(answer.headers.get("retry-after", "1")), MAX_WAIT))

    def post(self, path: str, body: Any) -> Answer:
        return self.ask("POST", path, json.dumps(body).encode())

    def close(self) -> None:
        self._connection.close()


def shares(settings: Settings) -> Iterator[Row]:
    """p99 of one client's single frames beside eight clients of single frames, and beside eight of batches."""
    wanted, seconds = images(BATCH_BESIDE, settings.scene.stem), settings.seconds(SHARES_MINUTES)
    batch = {"frames": [each.body() for each in wanted]}
    with services(settings.scene, settings.work, 1) as running:
        times = {
            path: _beside(running, seconds, wanted[0].body(), path, body)
            for path, body in (("/render", wanted[0].body()), ("/render/batch", batch))
        }
    p99 = {path: 1000 * float(np.quantile(took, 0.99)) for path, took in times.items()}
    ratio = p99["/render/batch"] / p99["/render"]
    measured = f"{ratio:.2f}: {p99['/render/batch']:.0f} and {p99['/render']:.0f} ms, of {[*map(len, times.values())]}"
    name = f"a frame's p99 beside {NEIGHBORS} clients of batches, relative to {NEIGHBORS} clients of frames"
    yield Row(name, "<= 3", measured, ratio <= 3)


def _beside(running: list[Running], seconds: float, frame: Any, path: str, body: Any) -> list[float]:
    """Seconds of each frame of one client while its neighbors call without a pause."""
    stop, took = threading.Event(), list[float]()

    def neighbor(number: int) -> None:
        client = Client(number, running[0].port)
        while not stop.is_set():
            client.post(path, body)
        client.close()

    with ThreadPoolExecutor(NEIGHBORS) as pool:
        asked = [pool.submit(neighbor, number) for number in range(1, NEIGHBORS + 1)]
        client, ends = Client(0, running[0].port), time.monotonic() + seconds
        time.sleep(min(2.0, seconds / 5))
        while time.monotonic() < ends:
            started = time.perf_counter()
            assert client.post("/render", frame).status == 200
            took.append(time.perf_counter() - started)
        stop.set()
        for each in asked:
            each.result()
    return took


class Soak:
    """The actions of the clients, and the errors that they find."""

    def __init__(self, folder: Path, work: Path, port: int, *, seconds: float) -> None:
        offline = Offline(folder)
        self.port = port
        self.wrong: list[str] = []
        self.done: Counter[str] = Counter()
        self.statuses: Counter[int] = Counter()
        self._ends = time.monotonic() + seconds
        self._wanted = mixed(CATALOGUE, [path.stem for path in sorted(folder.glob("*.onnx"))])
        self._expected = {wanted: digest(offline.draw(wanted)) for wanted in self._wanted}
        self._files = [write_scene(work / f"{n}.onnx", static_color=color) for n, color in enumerate(COLORS)]
        small = Wanted("", 30.0, 0.5, 64, "png")
        drawn = Offline(work)
        self._small = [(small._replace(scene=path.stem), digest(drawn.draw(small._replace(scene=path.stem))))
                       for path in self._files]  # fmt: skip
        self._videos: dict[int, np.ndarray] = {}  # by first frame: the video as it was first received
        self._bad = [_external(self._files[0]), self._files[0].read_bytes()[:200], b"no scene", b""]
        self._lock = threading.Lock()

    def client(self, number: int) -> None:
        """Random actions of one client until the time is over."""
        chance, client = random.Random(number), Client(number, self.port)
        actions: list[tuple[Callable[[Client, random.Random], None], int]] = [
            (self._frame, 20), (self._batch, 3), (self._video, 1), (self._upload, 2), (self._damaged, 2),
            (self._hostile, 2), (self._leave, 1),
        ]  # fmt: skip
        while time.monotonic() < self._ends:
            (action,) = chance.choices([each for each, _ in actions], [weight for _, weight in actions])
            try:
                action(client, chance)
            except OSError as error:
                self._expect(False, f"{action.__name__}: {error!r}")
            with self._lock:
                self.done[action.__name__] += 1
        client.close()
        with self._lock:
            self.statuses += client.statuses

    def _expect(self, holds: bool, problem: str) -> None:
        if not holds:
            with self._lock:
                self.wrong.append(problem)

    def _frame(self, client: Client, chance: random.Random) -> None:
        wanted = chance.choice(self._wanted)
        answer = client.post("/render", wanted.body())
        self._expect((answer.status, digest(answer.body)) == (200, self._expected[wanted]), f"{wanted}")

    def _batch(self, client: Client, chance: random.Random) -> None:
        several = [chance.choice(self._wanted) for _ in range(BATCH)]
        answer = client.post("/render/batch", {"frames": [each.body() for each in several]})
        lines = [json.loads(line) for line in answer.body.splitlines()]
        found = {line["index"]: digest(base64.b64decode(line.get("data", ""))) for line in lines}
        self._expect(found == {n: self._expected[each] for n, each in enumerate(several)}, "a batch")

    def _video(self, client: Client, chance: random.Random) -> None:
        start = chance.randrange(4)
        frames = [{"camera": {"type": "orbit", "azimuth": 9 * (start + n), "elevation": 20}, "t": n / VIDEO_FRAMES}
                  for n in range(VIDEO_FRAMES)]  # fmt: skip
        body = {"scene": "first", "frames": frames, "width": 160, "height": 120}
        answer = client.post("/render/video", body)
        shown = np.zeros(0)
        if answer.status == 200:
            with av.open(io.BytesIO(answer.body), "r") as video:
                shown = np.stack([frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]).astype(float)
        with self._lock:
            first = self._videos.setdefault(start, shown)
        # x264 doesn't always write the same bytes
        is_same = (
            shown.shape == (VIDEO_FRAMES, 120, 160, 3) and float(np.abs(shown - first).mean()) < MAX_VIDEO_DIFFERENCE
        )
        self._expect(is_same, f"a video of {len(shown)} frames, {answer.status}")

    def _upload(self, client: Client, chance: random.Random) -> None:
        """A scene is added on one service, drawn and deleted on either, and then missing on both."""
        number = chance.randrange(len(COLORS))
        name = f"soak-{client.number}-{chance.getrandbits(64)}"
        added = client.ask("POST", f"/scenes?name={name}", self._files[number].read_bytes())
        self._expect(added.status == 201, f"upload: {added.status}")
        wanted, expected = self._small[number]
        answer = client.post("/render", wanted._replace(scene=name).body())
        self._expect((answer.status, digest(answer.body)) == (200, expected), f"uploaded scene: {answer.status}")
        deleted = client.ask("DELETE", f"/scenes/{name}")
        gone = [client.ask("GET", f"/scenes/{name}?t={each}").status for each in range(4)]  # t selects the service
        self._expect((deleted.status, gone) == (204, 4 * [404]), f"delete: {deleted.status}, {gone}")

    def _damaged(self, client: Client, chance: random.Random) -> None:
        """A scene file with flipped bits: it is refused, or drawn and deleted."""
        content = bytearray(chance.choice(self._files).read_bytes())
        for _ in range(chance.randint(1, 4)):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        name = f"soak-{client.number}-{chance.getrandbits(64)}"
        status = client.ask("POST", f"/scenes?name={name}", bytes(content)).status
        self._expect(status in (201, 422), f"damaged file: {status}")
        if status == 201:
            client.post("/render", self._small[0][0]._replace(scene=name).body())
            self._expect(client.ask("DELETE", f"/scenes/{name}").status == 204, "delete of a damaged file")

    def _hostile(self, client: Client, chance: random.Random) -> None:
        status = client.ask("POST", "/scenes?name=hostile", chance.choice(self._bad)).status
        self._expect(status == 422, f"hostile file: {status}")
        for path in ("/render", "/render/batch", "/render/video"):
            status = client.ask("POST", path, chance.choice(HOSTILE_BODIES)).status
            self._expect(status in (400, 422), f"hostile body: {status}")

    def _leave(self, client: Client, chance: random.Random) -> None:
        """Disconnect in the middle of a batch or an upload."""
        body = json.dumps({"frames": [each.body() for each in self._wanted]}).encode()
        path, length = chance.choice([("/render/batch", len(body)), ("/scenes?name=half", len(body) + 1)])
        head = f"POST {path} HTTP/1.1\r\nHost: x\r\nX-API-Key: {key(client.number)}\r\nContent-Length: {length}\r\n"
        with socket.create_connection(("127.0.0.1", self.port)) as connection:
            connection.sendall(head.encode() + b"Content-Type: application/json\r\n\r\n" + body)
            time.sleep(chance.random())


def _external(scene: Path) -> bytes:
    """A scene whose colors are stored in another file of the machine."""
    model = onnx.load(scene)
    tensor = next(each for each in model.graph.initializer if each.name == "all_sh")
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    for name, value in {"location": "/etc/passwd", "length": "24"}.items():
        entry = tensor.external_data.add()
        entry.key, entry.value = name, value
    return model.SerializeToString()


def soak(settings: Settings) -> Iterator[Row]:
    """Sixteen clients on two services: no wrong answer, no lost or leftover file, no growing memory."""
    folder, seconds = settings.folder, settings.seconds(SOAK_MINUTES)
    small, nginx = settings.work / "small", settings.work / "nginx"
    small.mkdir()
    nginx.mkdir()
    before = sorted(path.name for path in folder.iterdir())
    with (
        services(folder, settings.work, 2, uploads=True, body_seconds=5, queued_renders=2 * CLIENTS) as running,
        running_nginx(nginx, [each.port for each in running], read_seconds=60) as proxy,
        ProcessPoolExecutor(len(running), multiprocessing.get_context("spawn")) as watching,
        ThreadPoolExecutor(CLIENTS) as pool,
    ):
        mixture = Soak(folder, small, proxy.base_url.port or 0, seconds=seconds)
        health = [watching.submit(watch_health, each.port, seconds) for each in running]
        clients = [pool.submit(mixture.client, number) for number in range(CLIENTS)]
        samples = list(_samples(running, clients))
        for each in clients:
            each.result()
        p99 = max(each.result().p99 for each in health)
        time.sleep(7)  # connections that were left open are closed
        left = [_handles(each) for each in running]
    title = f"{CLIENTS} clients, 2 services behind nginx, {seconds / 60:.1f} min"
    done = ", ".join(f"{count} {name.strip('_')}" for name, count in sorted(mixture.done.items()))
    yield Row(f"{title}: wrong answers", "none", f"{mixture.wrong[:5] or 'none'}; {done}", not mixture.wrong)
    bad = {status: count for status, count in mixture.statuses.items() if status >= 500 and status not in (503, 507)}
    yield Row(f"{title}: 5xx other than 503 and 507", "none", f"{bad or 'none'}; {dict(mixture.statuses)}", not bad)
    after = sorted(path.name for path in folder.iterdir())
    yield Row(f"{title}: files lost or left", "none", str(set(after) ^ set(before) or "none"), after == before)
    for number in range(len(running)):
        yield memory_row(f"service {number}: memory", [sample[number][0] for sample in samples])
        opened = [sample[number][1] for sample in samples]
        measured = f"{left[number]} after, maximum {max(opened)}, {opened[0]} at the start"
        yield Row(f"service {number}: handles after the load", "as before", measured, left[number] <= opened[0] + 4)
    yield Row("p99 of /live and /ready", "< 250 ms", f"{p99:.0f} ms", p99 < 250)


def _samples(running: list[Running], clients: Sequence[Any]) -> Iterator[list[tuple[int, int]]]:
    """Memory and open files of the services at regular intervals until the clients have ended."""
    while not all(each.done() for each in clients):
        yield [(each.resident_bytes(), _handles(each)) for each in running]
        time.sleep(SAMPLE_SECONDS)


def _handles(running: Running) -> int:
    return len(os.listdir(f"/proc/{running.process.pid}/fd"))
