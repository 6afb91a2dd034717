"""Work on a Ray cluster of this machine: the same bytes as without it, and recovery from lost workers."""

import filecmp
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from msdgs_serve.ray_tasks import MAX_LOSSES, RayTasks, WorkLost, ray_cluster, run_tasks
from msdgs_serve.render_cli import main
from msdgs_serve.scene import MsdgsError
from tests.support.scene_files import write_scene
from tests.support.service_on_ray import always_dies, dies_once, refuses

pytest.importorskip("ray", reason="needs Ray: make test-cluster")
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("ray")]  # one cluster at a time

CORES = 2


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[Any]:
    """A small cluster of one node, which `auto` finds."""
    patch = pytest.MonkeyPatch()
    patch.setenv("RAY_AUTH_MODE", "disabled")  # reachable from this machine only
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's own
        import ray  # pyright: ignore[reportMissingImports]
        from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

        arguments = {"num_cpus": CORES, "object_store_memory": 80 << 20, "include_dashboard": False}
        nodes = Cluster(initialize_head=True, head_node_args=arguments)
    patch.setenv("RAY_ADDRESS", nodes.address)
    yield nodes
    patch.undo()
    ray.shutdown()
    nodes.shutdown()


@pytest.fixture(autouse=True)
def rays_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def test_frames_are_the_same_bytes_and_are_not_drawn_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scene = write_scene(tmp_path / "balls.onnx")
    command = [str(scene), "--frames", "9", "--width", "24", "--height", "16"]
    assert main([*command[:1], str(tmp_path / "here"), *command[1:]]) == 0
    on_ray = [*command[:1], str(tmp_path / "ray"), *command[1:], "--ray", "auto"]
    assert main(on_ray) == 0
    files = sorted((tmp_path / "here").iterdir())
    assert [(file.name, file.read_bytes()) for file in files] == [
        (file.name, file.read_bytes()) for file in sorted((tmp_path / "ray").iterdir())
    ]
    assert f"Ray has {CORES} cores" in capsys.readouterr().err
    (tmp_path / "ray" / "frame_00004.png").unlink()
    assert main(on_ray) == 0
    printed = capsys.readouterr()
    assert "8 of 9 frames exist already" in printed.out
    assert "frame 1 of 1" in printed.err


def test_a_node_that_is_lost_costs_no_frame(tmp_path: Path, cluster: Any):
    scene, size = write_scene(tmp_path / "balls.onnx"), ["--frames", "60", "--width", "200", "--height", "200"]
    node = cluster.add_node(num_cpus=CORES, object_store_memory=80 << 20)
    assert main([str(scene), str(tmp_path / "here"), *size]) == 0
    with ThreadPoolExecutor(1) as pool:
        drawing = pool.submit(main, [str(scene), str(tmp_path / "ray"), *size, "--ray", "auto"])
        while not drawing.done() and len(list(tmp_path.glob("ray/frame_*"))) < 5:
            time.sleep(0.02)
        cluster.remove_node(node, allow_graceful=False)
        assert drawing.result() == 0
    names = sorted(file.name for file in (tmp_path / "here").iterdir())
    assert filecmp.cmpfiles(tmp_path / "here", tmp_path / "ray", names, shallow=False) == (names, [], [])


def test_a_worker_that_dies_costs_its_task_alone(tmp_path: Path):
    with ray_cluster("auto") as cores:
        results = dict(run_tasks(RayTasks(dies_once, tmp_path), list(range(12)), cores))
    assert results == {number: number * number for number in range(12)}
    assert (tmp_path / "died").exists()


def test_a_task_that_always_kills_its_worker_is_given_up():
    with ray_cluster("auto") as cores, pytest.raises(WorkLost, match=f"{MAX_LOSSES} times"):
        list(run_tasks(RayTasks(always_dies), [1], cores))


def test_domain_errors_are_raised_by_the_caller():
    with ray_cluster("auto") as cores, pytest.raises(MsdgsError, match="`number` must be another, got 1"):
        list(run_tasks(RayTasks(refuses), [1], cores))
