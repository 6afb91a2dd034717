"""A path drawn by two Ray nodes of this machine, against drawing it here: overhead, and a node that is killed midway.

    python benchmarks/ray_frames.py examples/toybench.onnx --frames 200 --size 800

Each node has one core, and local drawing two threads. Whole commands are timed and, apart from them, drawing alone:
from the first block given out to the last frame on disk, with the cluster and its workers warm, as those of a running
cluster are. All files are compared byte by byte.
"""

import argparse
import filecmp
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PROGRAM = "import sys; from msdgs_serve.render_cli import main; sys.exit(main())"
OBJECT_STORE_BYTES = 100 << 20
LOOK_SECONDS = 4.0  # a look costs seconds of a core, which a node that starts needs itself
DRAWN = re.compile(r"frame (\d+) of \1, ([\d.]+) a second")


def main() -> None:
    """Overhead in turns, then the loss of a node."""
    os.environ["RAY_AUTH_MODE"] = "disabled"  # nothing but this machine reaches the nodes
    options = parse_arguments()
    with tempfile.TemporaryDirectory() as temporary, two_nodes() as (address, nodes):
        folder = Path(temporary)
        local = folder / "here"
        times: dict[str, list[tuple[float, float]]] = {"here": [], "Ray": []}
        for _ in range(options.repeats):
            for name, ray in (("here", []), ("Ray", ["--ray", address])):
                out = folder / name
                shutil.rmtree(out, ignore_errors=True)
                times[name].append(timed(command(options, out, *ray)))
        print(f"{options.frames} frames of {options.size} × {options.size}, two cores, {options.repeats} turns, minima")
        for name, measured in times.items():
            whole, drawing = (min(column) for column in zip(*measured, strict=True))
            print(f"  {name:5} whole command {whole:.1f} s, drawing {drawing:.2f} s")
        ratios = [min(each[i] for each in times["Ray"]) / min(each[i] for each in times["here"]) for i in (0, 1)]
        print(
            f"  overhead of Ray: whole command {100 * (ratios[0] - 1):+.0f} %, drawing {100 * (ratios[1] - 1):+.0f} %"
        )
        compare(local, folder / "Ray")
        print(kill_midway(options, folder / "killed", address, nodes))
        compare(local, folder / "killed")


def kill_midway(options: argparse.Namespace, out: Path, address: str, nodes: list[subprocess.Popen]) -> str:
    """Start, wait for a third of the frames, kill the node that isn't the head with all of its workers."""
    with subprocess.Popen(command(options, out, "--ray", address), stderr=subprocess.PIPE) as process:
        while (there := len(list(out.glob("frame_*")))) < options.frames // 3:
            assert process.poll() is None, process.stderr and process.stderr.read().decode()
            time.sleep(0.02)
        kill_tree(nodes[-1].pid)
        process.communicate()
    assert process.returncode == 0
    return f"  one of two nodes killed after {there} frames: {len(list(out.glob('frame_*')))} are there in the end"


def command(options: argparse.Namespace, out: Path, *more: str) -> list[str]:
    """Of `msdgs-render`."""
    size = ["--width", str(options.size), "--height", str(options.size)]
    return [sys.executable, "-c", PROGRAM, str(options.scene), str(out), "--frames", str(options.frames), *size, *more]


def timed(line: list[str]) -> tuple[float, float]:
    """Seconds of the whole command, and of drawing as its progress says."""
    started = time.perf_counter()
    done = subprocess.run(line, check=True, capture_output=True, text=True)
    whole = time.perf_counter() - started
    found = DRAWN.search(done.stderr)
    assert found, done.stderr
    return whole, int(found[1]) / float(found[2])


def compare(one: Path, other: Path) -> None:
    """Exits where a file differs or isn't there."""
    names = sorted(path.name for path in one.glob("frame_*"))
    same, differing, missing = filecmp.cmpfiles(one, other, names, shallow=False)
    if differing or missing:
        sys.exit(f"FAILED: {len(differing)} files differ, {len(missing)} are missing")
    print(f"  {other.name}: all {len(same)} files are the same bytes as drawn here")


@contextmanager
def two_nodes() -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A Ray cluster of two nodes with a core each; its address and the processes of its nodes, the head first."""
    port = 6479
    ray = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--num-cpus=1", "--disable-usage-stats"]
    ray += ["--no-monitor", "--include-log-monitor=false"]
    ray += [f"--object-store-memory={OBJECT_STORE_BYTES}", "--node-ip-address=127.0.0.1"]
    address, nodes = f"127.0.0.1:{port}", []
    patience = {**os.environ, "RAY_agent_register_timeout_ms": "300000", "RAY_raylet_start_wait_time_s": "300"}
    try:
        for role in (["--head", f"--port={port}", "--include-dashboard=false"], [f"--address={address}"]):
            no, first = subprocess.DEVNULL, port + 10 * len(nodes)
            # agents whose ports are known are not waited for, which fails on a machine that is busy
            agents = [f"--dashboard-agent-grpc-port={first + 1}", f"--runtime-env-agent-port={first + 2}"]
            agents += [f"--dashboard-agent-listen-port={first + 3}", f"--metrics-export-port={first + 4}"]
            line = [*ray, *role, *agents]
            nodes.append(subprocess.Popen(line, stdout=no, stderr=no, start_new_session=True, env=patience))
            wait_for_cores(address, len(nodes))
        yield address, nodes
    finally:
        for node in reversed(nodes):
            kill_tree(node.pid)
            node.wait()


def wait_for_cores(address: str, count: int) -> None:
    """Until so many cores are in the cluster."""
    code = f"import ray; ray.init({address!r}, log_to_driver=False, logging_level='error'); "
    code += "print(ray.cluster_resources().get('CPU', 0)); ray.shutdown()"
    for _ in range(20):
        time.sleep(LOOK_SECONDS)
        done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
        if done.returncode == 0 and float(done.stdout.split()[-1]) >= count:
            return
    sys.exit(f"FAILED: the cluster did not come up\n{done.stderr}")


def kill_tree(pid: int) -> None:
    """A process and all that it has started."""
    parents = {int(path.name): parent(path) for path in Path("/proc").iterdir() if path.name.isdecimal()}
    doomed, found = [pid], [pid]
    while found:
        found = [child for child, of in parents.items() if of in found]
        doomed += found
    for each in doomed:
        try:
            os.kill(each, 9)
        except ProcessLookupError:
            continue


def parent(process: Path) -> int:
    """Of a process in /proc; 0 where it is gone."""
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def parse_arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--repeats", type=int, default=3)
    return parser.parse_args()


if __name__ == "__main__":
    main()
