"""What the service promises, measured: a table of bars, what was measured, and whether it is met.

python -m benchmarks.service                          everything, in under 5 minutes
python -m benchmarks.service --only load --minutes 5  one part; the load as long as one likes
python -m benchmarks.service --list                   the parts

Times mean something on a machine that does nothing else. Clients run on the same machine and take part of it.
"""

import argparse
import itertools
import re
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.service import promises
from benchmarks.service.load import Health, Tally, at_rate, overload, saturate
from benchmarks.service.process import Connection, Running, make_scenes, service
from benchmarks.service.requests import Offline, Wanted, digest, images, mixed
from msdgs_serve.api.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
CLIENTS = 32
CATALOGUE = 96  # different requests of the mixed load
FIRST = "first"  # of the scenes, the one that single measurements are made with
DEFAULTS = Settings()
PLACES = (DEFAULTS.concurrent_renders + DEFAULTS.queued_renders) // 2  # that one address may have, in work and in line
TOO_MUCH, OVERLOAD_TURNS = 4, 3
KILLS = 5
PACE = 0.5  # of the peak: below saturation


class Row(NamedTuple):
    """A line of the table."""

    what: str
    bar: str
    measured: str
    met: bool | None  # None: only told


class Setting(NamedTuple):
    """What the parts share."""

    scene: Path  # a file
    folder: Path  # of scenes
    seconds: float  # of the mixed load
    overload_seconds: float
    work: Path  # to write to


def main() -> None:
    """Measure, print the table, end with 1 where a bar isn't met."""
    arguments = parse_arguments()
    if arguments.list:
        for name, part in PARTS.items():
            print(f"{name:10} {(part.__doc__ or '').splitlines()[0]}")
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that services are ended too
    console = Console()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as work:
        folder = make_scenes(Path(work) / "scenes", arguments.scene)
        setting = Setting(arguments.scene, folder, 60 * arguments.minutes, arguments.overload_seconds, Path(work))
        for name in arguments.only or PARTS:
            started = time.monotonic()
            found = list(PARTS[name](setting))
            rows += found
            console.print(
                f"{name}: {time.monotonic() - started:.0f} s", *[f"  {_line(row)}" for row in found], sep="\n"
            )
    table = Table("promise", "bar", "measured", "met", title=time.strftime("%Y-%m-%d"))
    for row in rows:
        table.add_row(row.what, row.bar, row.measured, {True: "yes", False: "NO", None: ""}[row.met])
    Console(width=max(console.width, 120)).print(table)
    sys.exit(any(row.met is False for row in rows))


def _line(row: Row) -> str:
    return f"{row.what}: {row.measured} (bar: {row.bar})"


def cold_start(setting: Setting) -> Iterator[Row]:
    """From the start of the process to its first frame, with kernels compiled before."""
    took = []
    for _ in range(4):
        started = time.perf_counter()
        with service(setting.scene) as running:
            body = {"camera": promises.ORBIT, "t": 0.5, "width": 400, "height": 400}
            assert running.ask("POST", "/render", body).status == 200
            took.append((time.perf_counter() - started, running.processor_seconds()))
    least, processor = min(took[1:])
    measured = f"{least:.2f} s, of the processor {processor:.2f} s"
    yield Row("cold start to the first frame, best of 3", "< 3 s", measured, least < 3)


def overhead(setting: Setting) -> Iterator[Row]:
    """HTTP, validation, queue and encoding of a 400 × 400 JPEG, beyond posing and drawing it."""
    with service(setting.folder) as running:
        beyond, client = _overheads(running, repeats=100)
    measured = f"{statistics.median(beyond):.1f} ms p50, least {min(beyond):.1f} ms; {client:.1f} ms are the client's"
    yield Row("400×400 JPEG, beyond pose and draw", "< 8 ms p50", measured, statistics.median(beyond) < 8)


def _overheads(running: Running, repeats: int) -> tuple[list[float], float]:
    """Milliseconds of calls beyond `pose` and `draw`, and what the client's own work is of a call (processor time)."""
    connection, beyond = Connection(running.port), []
    worked = time.process_time()
    for number, wanted in enumerate(images(repeats + 5, FIRST)):
        if number == 5:
            worked = time.process_time()
        started = time.perf_counter()
        answer = connection.ask("POST", "/render", wanted.body())
        milliseconds = 1000 * (time.perf_counter() - started)
        assert answer.status == 200
        stages = dict(re.findall(r"(\w+);dur=([\d.]+)", answer.headers["server-timing"]))
        if number >= 5:
            beyond.append(milliseconds - float(stages["pose"]) - float(stages["draw"]))
    client = 1000 * (time.process_time() - worked) / repeats
    connection.close()
    return beyond, client


def load(setting: Setting) -> Iterator[Row]:
    """32 clients, all scenes, times, sizes and formats mixed; every body is compared with the offline render."""
    requests, offline = mixed(CATALOGUE, ["first", "second", "balls"]), Offline(setting.folder)
    expected = {wanted: digest(offline.draw(wanted)) for wanted in requests}
    before = _raw(offline, requests)
    with service(setting.folder, queued_renders=2 * CLIENTS) as running:
        client = time.process_time()
        tally = saturate(running, requests, CLIENTS, setting.seconds)
        client = (time.process_time() - client) / tally.lasted
    after = _raw(offline, requests)
    raw = (before + after) / 2
    bad = {status: count for status, count in tally.statuses.items() if status not in (200, 503)}
    yield Row(f"{CLIENTS} clients, mixed, {setting.seconds:.0f} s: no 5xx but 503", "none", str(bad or "none"), not bad)
    ratio = tally.frames_a_second / raw
    measured = f"{tally.frames_a_second:.1f} of {raw:.1f} frames/s: {ratio:.0%}; clients take {client:.0%} of a core"
    yield Row("its throughput, of renderer and encoder alone", ">= 90 %", measured, ratio >= 0.9)
    wrong = sum(count for (wanted, found), count in tally.bodies.items() if expected[wanted] != found)
    yield Row(
        "bodies equal the offline render", "all", f"{tally.bodies.total() - wrong} of {tally.bodies.total()}", not wrong
    )
    yield _memory(tally)


def _raw(offline: Offline, requests: list[Wanted]) -> float:
    """Frames a second without HTTP, asked for by one thread; the first round poses, which the service does too."""
    started = time.perf_counter()
    for wanted in requests:
        offline.draw(wanted)
    return len(requests) / (time.perf_counter() - started)


def _memory(tally: Tally) -> Row:
    """The last fifth of the time beside the second: minutes, where the load lasts five."""
    fifth = tally.lasted / 5
    second, last = (
        float(np.median([size for at, size in tally.resident if part * fifth <= at < (part + 1) * fifth]))
        for part in (1, 4)
    )
    measured = f"{last / second - 1:+.1%} ({second / 2**20:.0f} to {last / 2**20:.0f} MiB)"
    return Row("memory, the last fifth of the time beside the second", "within 5 %", measured, last / second <= 1.05)


def too_much(setting: Setting) -> Iterator[Row]:
    """Half of what the service can do, all, and four times as much, of 400 × 400 JPEGs.

    All and too much in turns: a machine's speed may change by a half within a minute.
    """
    requests = images(1000, FIRST)
    seconds = setting.overload_seconds / OVERLOAD_TURNS
    with service(setting.folder) as running:
        peaks, tallies, health = [saturate(running, requests, 8, 5).frames_a_second], list[Tally](), list[Health]()
        paced = at_rate(running, requests, CLIENTS, 15, PACE * peaks[0])
        for _ in range(OVERLOAD_TURNS):
            tally, looked = overload(running, requests, 64, seconds, TOO_MUCH * peaks[-1])
            tallies.append(tally)
            health.append(looked)
            peaks.append(saturate(running, requests, 8, 5).frames_a_second)
    yield Row("8 clients, 400×400 JPEG", "", f"{', '.join(f'{peak:.0f}' for peak in peaks)} frames/s", None)
    ratio = paced.milliseconds(0.99) / paced.milliseconds(0.5)
    measured = f"{ratio:.1f} ({paced.milliseconds(0.5):.0f} and {paced.milliseconds(0.99):.0f} ms)"
    yield Row(f"at {PACE:.0%} of that: p99 / p50", "< 3", measured, ratio < 3)
    title = f"{TOO_MUCH}× overload, {OVERLOAD_TURNS} × {seconds:.0f} s"
    late = np.concatenate([np.array(tally.seconds) * tally.frames_a_second / PLACES for tally in tallies])
    p99 = float(np.quantile(late, 0.99))
    measured = f"{p99:.2f} ({', '.join(f'{tally.milliseconds(0.99):.0f}' for tally in tallies)} ms)"
    yield Row(f"{title}: p99 of accepted / queue bound", "<= 2", measured, p99 <= 2)
    before_and_after = [(before + after) / 2 for before, after in itertools.pairwise(peaks)]
    possible = sum(peak * tally.lasted for peak, tally in zip(before_and_after, tallies, strict=True))
    statuses = sum((tally.statuses for tally in tallies), Counter[int]())
    goodput = statuses[200] / possible
    measured = f"{goodput:.0%}; {dict(statuses)}"
    yield Row(f"{title}: goodput of the peaks before and after", ">= 80 %", measured, goodput >= 0.8)
    worst = max(looked.p99 for looked in health)
    seen = sum((Counter(looked.statuses) for looked in health), Counter[int]())
    measured = f"{worst:.0f} ms, {dict(seen)}"
    fine = worst < 250 and set(seen) == {200}
    yield Row(f"{title}: p99 of /live and /ready, the worst turn", "< 250 ms, all 200", measured, fine)


def faults(setting: Setting) -> Iterator[Row]:
    """Clients that leave, are slow or ask for too much; scenes that change; an end while there is work."""
    free = promises.seconds_until_free(setting.scene)
    measured = ", ".join(f"{seconds:.2f}" for seconds in free) + " s"
    yield Row("client gone at 10, 50, 90 %: work ends within", "0.5 s", measured, max(free) < 0.5)
    late = promises.seconds_to_deadline(setting.scene)
    yield Row("1 s deadline on a render of more than 10 s: 504 after", "1.5 s", f"{late:.2f} s", late < 1.5)
    gentle = promises.stops_gently(setting.scene)
    yield Row("SIGTERM with 8 in flight: all finish, /ready 503", "yes", "yes" if gentle else "no", gentle)
    took, statuses = promises.slow_sockets(setting.scene)
    fine = took < 15 and set(statuses) == {200}
    yield Row("200 slow sockets are closed; others meanwhile", "15 s, all 200", f"{took:.1f} s, {dict(statuses)}", fine)


def changes(setting: Setting) -> Iterator[Row]:
    """A scene that changes a hundred times under load."""
    folder = setting.work / "changing"
    folder.mkdir()
    frames, mixtures, statuses = promises.reloads(folder)
    fine = not mixtures and set(statuses) == {200}
    measured = f"{mixtures} of {frames} frames are of no version, {dict(statuses)}"
    yield Row("reload × 100 under load: frames of no single version", "none", measured, fine)


def kills(setting: Setting) -> Iterator[Row]:
    """kill -9 while scenes are uploaded and replaced."""
    folder = setting.work / "killed"
    folder.mkdir()
    whole, uploads = promises.survives_kills(folder, KILLS)
    measured = f"{whole} of {KILLS}, amid {uploads} uploads"
    yield Row("kill -9 during upload and replacement: a whole scene, nothing left", "all", measured, whole == KILLS)


def counts(setting: Setting) -> Iterator[Row]:
    """Metrics beside a client's own counts."""
    agree = promises.counts_agree(setting.folder / "balls.onnx", 10_000)
    yield Row("metrics after 10,000 requests are the client's counts", "equal", "equal" if agree else "not", agree)


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "start": cold_start,
    "overhead": overhead,
    "load": load,
    "overload": too_much,
    "faults": faults,
    "changes": changes,
    "kills": kills,
    "counts": counts,
}


def parse_arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "toybench.onnx", help="its time is [0, 1]")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help="these parts; --list tells which")
    parser.add_argument("--list", action="store_true", help="tell the parts and stop")
    parser.add_argument("--minutes", type=float, default=0.7, help="of the mixed load; the promise is for 5")
    parser.add_argument("--overload-seconds", type=float, default=60.0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
