"""Shares of the queue, and a long mixed load on two services, measured: a table of bars and whether they are met.

python -m benchmarks.service.soak shares               a single frame beside clients of batches and of single frames
python -m benchmarks.service.soak soak --minutes 30    frames, batches, films, uploads, damaged and hostile files

The mixed load runs on two services that share a folder behind nginx with the settings of docker/. Each client has a key
of its own. Times mean something on a machine that does nothing else.
"""

import argparse
import base64
import io
import json
import multiprocessing
import os
import random
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
import onnx
from rich.console import Console
from rich.table import Table

from benchmarks.service.load import watch_health
from benchmarks.service.process import Answer, Connection, Running, make_scenes, proxy, service
from benchmarks.service.requests import Offline, Wanted, digest, images, mixed
from tests.support.scene_files import write_scene

ROOT = Path(__file__).resolve().parents[2]
CLIENTS, NEIGHBOURS = 16, 8
CATALOGUE, BATCH, BATCH_BESIDE, FILM = 48, 12, 200, 8
COLORS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
MAX_WAIT = 5.0
ALIKE = 1.0  # mean difference of two films of the same frames, of 255
SAMPLE_SECONDS = 1.0
HOSTILE_BODIES = (
    b'{"camera": ' + b"[" * 50_000,
    b'{"t": ' + b"9" * 400 + b', "camera": {"type": "orbit", "azimuth": 0, "elevation": 0}}',
    b'{"t": 1e999, "camera": {"type": "orbit", "azimuth": NaN, "elevation": 0}, "width": -1}',
    b"\xff\xfe" * 100,
)


class Row(NamedTuple):
    """A line of the table."""

    what: str
    bar: str
    measured: str
    met: bool


def key(number: int) -> str:
    """Of a client."""
    return f"client-{number:02d}-0123456789"


@contextmanager
def services(folder: Path, work: Path, count: int, **flags: Any) -> Iterator[list[Running]]:
    """So many over one folder, with a key for each client."""
    keys = work / "keys"
    keys.write_text("".join(f"read,write {key(number)}\n" for number in range(CLIENTS)))
    with ExitStack() as stack:
        yield [stack.enter_context(service(folder, api_keys_file=keys, **flags)) for _ in range(count)]


class Client:
    """With a key and a connection of its own."""

    def __init__(self, number: int, port: int) -> None:
        self.number = number
        self.statuses: Counter[int] = Counter()
        self._headers = {"Content-Type": "application/json", "X-API-Key": key(number)}
        self._connection = Connection(port)

    def ask(self, method: str, path: str, content: bytes | None = None) -> Answer:
        """Again if the service is full, when it says so."""
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


def shares(scene: Path, work: Path, seconds: float) -> Iterator[Row]:
    """p99 of one client's single frames beside eight clients of single frames, and beside eight of batches."""
    wanted = images(BATCH_BESIDE, scene.stem)
    batch = {"frames": [each.body() for each in wanted]}
    with services(scene, work, 1) as running:
        times = {
            path: _beside(running, seconds, wanted[0].body(), path, body)
            for path, body in (("/render", wanted[0].body()), ("/render/batch", batch))
        }
    p99 = {path: 1000 * float(np.quantile(took, 0.99)) for path, took in times.items()}
    ratio = p99["/render/batch"] / p99["/render"]
    measured = f"{ratio:.2f}: {p99['/render/batch']:.0f} and {p99['/render']:.0f} ms, of {[*map(len, times.values())]}"
    what = f"a frame's p99 beside {NEIGHBOURS} clients of batches, of that beside {NEIGHBOURS} of frames"
    yield Row(what, "<= 3", measured, ratio <= 3)


def _beside(running: list[Running], seconds: float, frame: Any, path: str, body: Any) -> list[float]:
    """Seconds of one client's frames while neighbours call without a pause."""
    stop, took = threading.Event(), list[float]()

    def neighbour(number: int) -> None:
        client = Client(number, running[0].port)
        while not stop.is_set():
            client.post(path, body)
        client.close()

    with ThreadPoolExecutor(NEIGHBOURS) as pool:
        asked = [pool.submit(neighbour, number) for number in range(1, NEIGHBOURS + 1)]
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
    """What clients do, and what they find wrong."""

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
        self._films: dict[int, np.ndarray] = {}  # what the first of its kind showed
        self._bad = [_external(self._files[0]), self._files[0].read_bytes()[:200], b"no scene", b""]
        self._lock = threading.Lock()

    def client(self, number: int) -> None:
        """Until the time is over."""
        chance, client = random.Random(number), Client(number, self.port)
        actions: list[tuple[Callable[[Client, random.Random], None], int]] = [
            (self._frame, 20), (self._batch, 3), (self._film, 1), (self._upload, 2), (self._damaged, 2),
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

    def _expect(self, holds: bool, what: str) -> None:
        if not holds:
            with self._lock:
                self.wrong.append(what)

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

    def _film(self, client: Client, chance: random.Random) -> None:
        start = chance.randrange(4)
        frames = [{"camera": {"type": "orbit", "azimuth": 9 * (start + n), "elevation": 20}, "t": n / FILM}
                  for n in range(FILM)]  # fmt: skip
        body = {"scene": "first", "frames": frames, "width": 160, "height": 120}
        answer = client.post("/render/video", body)
        shown = np.zeros(0)
        if answer.status == 200:
            with av.open(io.BytesIO(answer.body), "r") as film:
                shown = np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]).astype(float)
        with self._lock:
            first = self._films.setdefault(start, shown)
        # x264 doesn't always write the same bytes
        alike = shown.shape == (FILM, 120, 160, 3) and float(np.abs(shown - first).mean()) < ALIKE
        self._expect(alike, f"a film of {len(shown)} frames, {answer.status}")

    def _upload(self, client: Client, chance: random.Random) -> None:
        """Added on one service, drawn and deleted on whichever answers, and gone from both."""
        number = chance.randrange(len(COLORS))
        name = f"soak-{client.number}-{chance.getrandbits(64)}"
        added = client.ask("POST", f"/scenes?name={name}", self._files[number].read_bytes())
        self._expect(added.status == 201, f"upload: {added.status}")
        wanted, expected = self._small[number]
        answer = client.post("/render", wanted._replace(scene=name).body())
        self._expect((answer.status, digest(answer.body)) == (200, expected), f"uploaded scene: {answer.status}")
        deleted = client.ask("DELETE", f"/scenes/{name}")
        gone = [client.ask("GET", f"/scenes/{name}?t={each}").status for each in range(4)]  # of both: t chooses which
        self._expect((deleted.status, gone) == (204, 4 * [404]), f"delete: {deleted.status}, {gone}")

    def _damaged(self, client: Client, chance: random.Random) -> None:
        """A few bits of a scene are other ones: refused, or a scene that is drawn and deleted again."""
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
        """In the middle of a batch, or of an upload."""
        body = json.dumps({"frames": [each.body() for each in self._wanted]}).encode()
        path, length = chance.choice([("/render/batch", len(body)), ("/scenes?name=half", len(body) + 1)])
        head = f"POST {path} HTTP/1.1\r\nHost: x\r\nX-API-Key: {key(client.number)}\r\nContent-Length: {length}\r\n"
        with socket.create_connection(("127.0.0.1", self.port)) as connection:
            connection.sendall(head.encode() + b"Content-Type: application/json\r\n\r\n" + body)
            time.sleep(chance.random())


def _external(scene: Path) -> bytes:
    """A scene whose colors lie in a file of the machine."""
    model = onnx.load(scene)
    tensor = next(each for each in model.graph.initializer if each.name == "all_sh")
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    for name, value in {"location": "/etc/passwd", "length": "24"}.items():
        entry = tensor.external_data.add()
        entry.key, entry.value = name, value
    return model.SerializeToString()


def soak(scene: Path, work: Path, seconds: float) -> Iterator[Row]:
    """Sixteen clients on two services; nothing may be wrong, lost or left."""
    folder = make_scenes(work / "scenes", scene)
    (work / "small").mkdir()
    before = sorted(path.name for path in folder.iterdir())
    with (
        services(folder, work, 2, uploads=True, body_seconds=5, queued_renders=2 * CLIENTS) as running,
        proxy(running, work) as port,
        ProcessPoolExecutor(len(running), multiprocessing.get_context("spawn")) as watching,
        ThreadPoolExecutor(CLIENTS) as pool,
    ):
        mixture = Soak(folder, work / "small", port, seconds=seconds)
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
    yield Row(f"{title}: answers that are wrong", "none", f"{mixture.wrong[:5] or 'none'}; {done}", not mixture.wrong)
    bad = {status: count for status, count in mixture.statuses.items() if status >= 500 and status not in (503, 507)}
    yield Row(f"{title}: 5xx but 503 and 507", "none", f"{bad or 'none'}; {dict(mixture.statuses)}", not bad)
    after = sorted(path.name for path in folder.iterdir())
    yield Row(f"{title}: files left or lost", "none", str(set(after) ^ set(before) or "none"), after == before)
    for number in range(len(running)):
        yield _flat(f"service {number}: memory", [sample[number][0] for sample in samples], 1 << 20, "MiB")
        opened = [sample[number][1] for sample in samples]
        measured = f"{left[number]} after, {max(opened)} at most, {opened[0]} at first"
        yield Row(f"service {number}: handles after the load", "as before", measured, left[number] <= opened[0] + 4)
    yield Row("p99 of /live and /ready", "< 250 ms", f"{p99:.0f} ms", p99 < 250)


def _samples(running: list[Running], clients: Sequence[Any]) -> Iterator[list[tuple[int, int]]]:
    """Memory and handles of the services, again and again until the clients have ended."""
    while not all(each.done() for each in clients):
        yield [(each.resident_bytes(), _handles(each)) for each in running]
        time.sleep(SAMPLE_SECONDS)


def _handles(running: Running) -> int:
    return len(os.listdir(f"/proc/{running.process.pid}/fd"))


def _flat(what: str, values: list[int], unit: int, name: str) -> Row:
    """The last fifth of the time beside the second."""
    fifth = max(1, len(values) // 5)
    second, last = float(np.median(values[fifth : 2 * fifth])), float(np.median(values[-fifth:]))
    measured = f"{last / second - 1:+.1%} ({second / unit:.0f} to {last / unit:.0f} {name})"
    return Row(f"{what}, the last fifth of the time beside the second", "within 5 %", measured, last / second <= 1.05)


def main() -> None:
    """Measure, print the table, end with 1 where a bar isn't met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("shares", "soak"))
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "toybench.onnx", help="its time is [0, 1]")
    parser.add_argument("--minutes", type=float, help="default 30 for soak, 0.5 for each half of shares")
    arguments = parser.parse_args()
    table = Table("promise", "bar", "measured", "met", title=time.strftime("%Y-%m-%d"))
    met = True
    with tempfile.TemporaryDirectory() as work:
        measure, minutes = (soak, 30.0) if arguments.part == "soak" else (shares, 0.5)
        for row in measure(arguments.scene, Path(work), 60 * (arguments.minutes or minutes)):
            table.add_row(row.what, row.bar, row.measured, "yes" if row.met else "NO")
            met &= row.met
    console = Console()
    Console(width=max(console.width, 120)).print(table)
    sys.exit(not met)


if __name__ == "__main__":
    main()
