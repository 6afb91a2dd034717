"""Load on a service of its own: what HTTP costs over the renderer, throughput and latency, and four times too much.

python benchmarks/load.py examples/toybench.onnx --seconds 20
"""

import argparse
import random
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit

SIZES, TIMES, FORMATS = (200, 300, 400), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), ("jpeg", "png", "webp")
START_SECONDS = 120


@dataclass
class Tally:
    """What clients saw."""

    seconds: list[float] = field(default_factory=list)  # of accepted requests
    statuses: Counter[int] = field(default_factory=Counter)
    health: list[float] = field(default_factory=list)
    health_statuses: Counter[int] = field(default_factory=Counter)

    def quantile(self, part: float, values: list[float] | None = None) -> float:
        """In milliseconds."""
        values = self.seconds if values is None else values
        return 1000 * float(np.quantile(values, part)) if values else float("nan")


def main() -> None:
    """Start the service, load it, print a table."""
    arguments = parse_arguments()
    port = free_port()
    command = [sys.executable, "-c", "import sys; from msdgs_serve.api.cli import main; sys.exit(main())"]
    command += [str(arguments.scene), "--port", str(port), "--queued-renders", str(arguments.queue)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            url = f"http://127.0.0.1:{port}"
            wait_until_ready(url)
            report(url, arguments)
        finally:
            process.terminate()
            process.wait()


def report(url: str, arguments: argparse.Namespace) -> None:
    """The three measurements."""
    scene = arguments.scene.stem
    http, drawn = overhead(url, scene, arguments.repeats)
    print(f"400×400 JPEG, one client: {http:.1f} ms over HTTP, of which {drawn:.1f} ms pose and draw (p50)")
    print(f"  HTTP, validation, queue and encoding: {http - drawn:.1f} ms")
    raw = raw_frames_a_second(arguments.scene, arguments.repeats)
    print(f"400×400, the renderer alone, one thread asking: {raw:.1f} frames a second")
    for clients in (2, arguments.clients):
        tally = load(url, scene, clients, arguments.seconds, lambda _: 400, patient=True)
        show(f"{clients} clients, 400×400 JPEG", tally, arguments.seconds)
    show(
        f"{arguments.clients} clients, mixed", load(url, scene, arguments.clients, arguments.seconds), arguments.seconds
    )
    many = 4 * (arguments.queue + 4)
    tally = load(url, scene, many, arguments.seconds, lambda _: 400)
    show(f"{many} clients, four times what has a place", tally, arguments.seconds)


def show(title: str, tally: Tally, seconds: float) -> None:
    """One line of the table, and one on the health checks."""
    good = tally.statuses[200]
    others = {status: count for status, count in sorted(tally.statuses.items()) if status != 200}
    print(f"{title}: {good / seconds:.1f} frames a second; p50 {tally.quantile(0.5):.0f} ms, "
          f"p99 {tally.quantile(0.99):.0f} ms; others: {others or 'none'}")  # fmt: skip
    print(f"  /live and /ready: p99 {tally.quantile(0.99, tally.health):.0f} ms, {dict(tally.health_statuses)}")


def overhead(url: str, scene: str, repeats: int) -> tuple[float, float]:
    """Milliseconds of a whole call, and of pose and draw in it, as medians."""
    whole, drawn = [], []
    with httpx.Client(base_url=url, timeout=60) as client:
        for number in range(repeats + 3):
            started = time.perf_counter()
            response = client.post("/render", json=body(scene, 400, number, "jpeg", 0.5))
            seconds = time.perf_counter() - started
            response.raise_for_status()
            stages = dict(part.split(";")[:2] for part in response.headers["Server-Timing"].split(", "))
            if number >= 3:
                whole.append(1000 * seconds)
                drawn.append(sum(float(stages[name].removeprefix("dur=")) for name in ("pose", "draw")))
    return statistics.median(whole), statistics.median(drawn)


def raw_frames_a_second(path: Path, repeats: int) -> float:
    """Without HTTP, in this process."""
    session, renderer = DeformationSession(path), Renderer()
    view = framing(session.scene.metadata)
    started = 0.0
    for number in range(repeats + 3):
        if number == 3:
            started = time.perf_counter()
        pose = orbit(view.target, view.distance, 37 * number, 20, view.up)
        renderer.render(session, Camera.from_fov(pose, 400, 400, view.fov_y), 0.5)
    return repeats / (time.perf_counter() - started)


def load(
    url: str,
    scene: str,
    clients: int,
    seconds: float,
    size: Callable[[random.Random], int] = lambda chance: chance.choice(SIZES),
    *,
    patient: bool = False,
) -> Tally:
    """Clients that ask again as soon as they are answered; where `patient`, those refused wait as they are told."""
    tally, lock, stop = Tally(), threading.Lock(), time.monotonic() + seconds

    def ask(seed: int) -> None:
        chance = random.Random(seed)
        with httpx.Client(base_url=url, timeout=120) as client:
            while time.monotonic() < stop:
                image_format = "jpeg" if patient else chance.choice(FORMATS)
                asked = body(scene, size(chance), chance.randrange(1000), image_format, chance.choice(TIMES))
                started = time.perf_counter()
                response = client.post("/render", json=asked)
                took = time.perf_counter() - started
                with lock:
                    tally.statuses[response.status_code] += 1
                    if response.status_code == 200:
                        tally.seconds.append(took)
                if response.status_code == 503:
                    time.sleep(float(response.headers["Retry-After"]) if patient else 0.25)

    def look() -> None:
        with httpx.Client(base_url=url, timeout=120) as client:
            while time.monotonic() < stop:
                for path in ("/live", "/ready"):
                    started = time.perf_counter()
                    status = client.get(path).status_code
                    tally.health.append(time.perf_counter() - started)
                    tally.health_statuses[status] += 1
                time.sleep(0.05)

    threads = [threading.Thread(target=ask, args=(seed,)) for seed in range(clients)] + [threading.Thread(target=look)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return tally


def body(scene: str, size: int, number: int, image_format: str, t: float) -> dict[str, object]:
    """A frame from somewhere around the scene; no two numbers give the same."""
    camera = {"type": "orbit", "azimuth": 37 * number % 360, "elevation": 20}
    return {"scene": scene, "camera": camera, "t": t, "width": size, "height": size, "format": image_format}


def wait_until_ready(url: str) -> None:
    """Until scenes are loaded."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        try:
            if httpx.get(f"{url}/ready").status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise SystemExit("the service did not become ready")


def free_port() -> int:
    """One that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def parse_arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a scene file (.onnx) whose time is [0, 1]")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each load")
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--queue", type=int, default=16, help="frames that may wait")
    parser.add_argument("--repeats", type=int, default=50, help="calls of one client")
    return parser.parse_args()


if __name__ == "__main__":
    main()
