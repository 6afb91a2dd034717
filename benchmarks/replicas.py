"""Three replicas behind the proxy of the composition: how often a pose is kept, by affinity and in turns.

    python benchmarks/replicas.py examples/toybench.onnx

nginx runs with docker/nginx/nginx.conf, its paths and ports apart; for turns, without its line `hash`. The trace is
that of benchmarks/scaling.py, and the simulation's hit rates stand beside. Needs nginx.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.scaling import SCENES, TIMES, ask_together, bytes_of_poses, copies
from benchmarks.service_process import Connection, free_port, service
from benchmarks.traffic import Fleet, Routing, Stages, heavy_tailed, simulate_clients
from msdgs_serve.deformation import DeformationSession

REPLICAS = 3
CLIENTS = 6
NGINX = Path(__file__).parents[1] / "docker" / "nginx" / "nginx.conf"
LOOKUPS = re.compile(r'^msdgs_pose_cache_lookups_total\{result="(hit|miss)"\} (\S+)$', re.MULTILINE)


def main() -> None:
    """Both routings, each with fresh replicas."""
    options = parse_arguments()
    if shutil.which("nginx") is None:
        sys.exit("needs nginx")
    session = DeformationSession(options.scene)
    poses = (options.cache_megabytes << 20) // bytes_of_poses(session)
    trace = heavy_tailed(options.frames, SCENES, TIMES)
    print(f"{REPLICAS} replicas, {poses} poses each, {options.frames} frames of {SCENES} scenes × {TIMES} times")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        scenes = copies(options.scene, folder / "scenes")
        routings: tuple[Routing, ...] = ("affinity", "round robin")
        for routing in routings:
            flags = {"threads": 1, "concurrent_renders": 1, "cache_megabytes": options.cache_megabytes}
            with ExitStack() as stack:
                ports = [stack.enter_context(service(scenes, **flags)).port for _ in range(REPLICAS)]
                proxy = stack.enter_context(nginx(folder / routing.replace(" ", "_"), ports, routing))
                before = lookups(ports)
                started = time.perf_counter()
                ask_together(proxy, session.scene.metadata, trace, range(options.frames), options.size, CLIENTS)
                seconds = time.perf_counter() - started
                hits, misses = (after - first for after, first in zip(lookups(ports), before, strict=True))
            one = Stages(np.array([0.01]), np.array([0.01]))  # times don't matter to who is asked
            expected = simulate_clients(trace, Fleet(REPLICAS, routing, poses=poses), one, CLIENTS).hit_rate
            print(
                f"  {routing:12} hit rate {hits / (hits + misses):.3f} (simulated {expected:.3f}), "
                f"{options.frames / seconds:.1f} frames a second on this machine's cores"
            )


def lookups(ports: list[int]) -> tuple[float, float]:
    """Hits and misses of all replicas so far."""
    counts = {"hit": 0.0, "miss": 0.0}
    for port in ports:
        page = Connection(port).ask("GET", "/metrics").body.decode()
        for result, value in LOOKUPS.findall(page):
            counts[result] += float(value)
    return counts["hit"], counts["miss"]


@contextmanager
def nginx(folder: Path, ports: list[int], routing: str) -> Iterator[int]:
    """The proxy of the composition over these ports; its own port."""
    folder.mkdir()
    port = free_port()
    text = NGINX.read_text().replace("listen 8080;", f"listen 127.0.0.1:{port};")
    text = text.replace("/tmp/", f"{folder}/").replace("/dev/stdout", f"{folder}/access.log")
    if routing != "affinity":
        text, count = re.subn(r"^\s*hash \$affinity;.*$", "", text, flags=re.MULTILINE)
        assert count == 1
    if os.geteuid() == 0:  # else its workers are nobody, who may not write here
        text = f"user root;\n{text}"
    (folder / "nginx.conf").write_text(text)
    (folder / "replicas.conf").write_text("".join(f"server 127.0.0.1:{each} max_fails=0;\n" for each in ports))
    command = ["nginx", "-p", str(folder), "-c", str(folder / "nginx.conf"), "-g", "daemon off;"]
    with subprocess.Popen(command) as process:
        try:
            for _ in range(200):
                time.sleep(0.1)
                try:
                    if Connection(port).ask("GET", "/ready").status == 200:
                        break
                except OSError:
                    continue
            yield port
        finally:
            process.terminate()
            process.wait()


def parse_arguments() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--size", type=int, default=200, help="pixels a side")
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--cache-megabytes", type=int, default=32)
    return parser.parse_args()


if __name__ == "__main__":
    main()
