"""The proxy of docker/nginx: no request is lost that a replica could answer, and none is repeated that changes scenes.

What happens when Docker's list of replicas changes is checked by docker/check.py.
"""

import contextlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from msdgs_serve.api.settings import Settings
from tests.support.nginx import needs_nginx
from tests.support.processes import wait_for
from tests.support.proxied_replicas import READ_SECONDS, Handler, Proxy, Replica, Server, proxying, running_nginx

pytestmark = needs_nginx
PROBLEM = "application/problem+json"
REPEATABLE = [("POST", "/render"), ("GET", "/render?t=0.5"), ("POST", "/render/batch"), ("POST", "/render/video"),
              ("GET", "/scenes"), ("GET", "/scenes/toys/file"), ("HEAD", "/")]  # fmt: skip
CHANGES = [("POST", "/scenes?name=new"), ("DELETE", "/scenes/toys")]


def frames(client: httpx.Client, count: int) -> list[int]:
    """Request frames of so many times; return the statuses."""
    return [client.post("/render", json={"scene": "toys", "t": t / count}).status_code for t in range(count)]


def check_that_another_answers(proxy: Proxy, method: str, path: str) -> None:
    """Request so many variants that one of them is sent to each replica first."""
    for number in range(8):
        url, mark = f"{path}{'&' if '?' in path else '?'}number={number}", f"{method}.{number}"
        assert proxy.client.request(method, url, headers={"X-Request-ID": mark}).status_code == 200
        assert proxy.log(mark)["method"] == method


@pytest.mark.parametrize(("method", "path"), REPEATABLE)
def test_another_replica_answers_if_one_closes_the_connection(tmp_path: Path, method: str, path: str):
    with proxying(tmp_path, 0, 200) as proxy:
        check_that_another_answers(proxy, method, path)


def test_another_replica_answers_if_one_is_full_or_stops(tmp_path: Path):
    with proxying(tmp_path, 503, 200) as proxy:
        for method, path in REPEATABLE:
            check_that_another_answers(proxy, method, path)


@pytest.mark.parametrize(("method", "path"), CHANGES)
def test_what_changes_scenes_is_not_repeated(tmp_path: Path, method: str, path: str):
    with proxying(tmp_path, 0, 0) as proxy:
        response = proxy.client.request(method, path, content=b"scene" if method == "POST" else None)
        assert (response.status_code, response.headers["content-type"]) == (503, PROBLEM)
        assert [asked for replica in proxy.replicas for asked in replica.asked] == [f"{method} {path}"]


@pytest.mark.slow
@pytest.mark.parametrize("path", ["/render", "/render/batch"])
def test_a_replica_that_hangs_costs_its_first_requests_their_time_and_is_left_out(tmp_path: Path, path: str):
    with proxying(tmp_path, None, 200) as proxy:
        hung, _ = proxy.replicas
        for t in range(40):
            assert proxy.client.post(path, json={"scene": "toys", "t": t}).status_code == 200
        assert frames(proxy.client, 20) == [200] * 20
        assert len(hung.asked) == 1


@pytest.mark.slow
@pytest.mark.parametrize("status", [None, 503])
def test_health_checks_find_a_replica_that_hangs_or_is_not_ready(tmp_path: Path, status: int | None):
    with proxying(tmp_path, status, 200) as proxy:
        first, _ = proxy.replicas
        for _ in range(40):
            assert proxy.client.get("/ready").status_code == 200
        assert frames(proxy.client, 20) == [200] * 20
        assert first.asked == ["GET /ready"]


def test_a_full_replica_is_not_left_out(tmp_path: Path):
    with proxying(tmp_path, 503, 200) as proxy:
        full, sound = proxy.replicas
        assert frames(proxy.client, 20) == [200] * 20
        before = len(full.asked)
        assert 1 < before < 40
        full.status = 200
        assert frames(proxy.client, 20) == [200] * 20
        assert len(sound.asked) < 40, "its frames are sent to it again"
        sound.status = full.status = 503
        response = proxy.client.post("/render", json={"t": 0})
        assert (response.status_code, response.headers["retry-after"]) == (503, "7")
        assert response.json()["detail"] == "from a replica"


@pytest.mark.parametrize("status", [0, 503])
def test_frames_of_other_replicas_are_cached_too(tmp_path: Path, status: int):
    with proxying(tmp_path, status, 200) as proxy:
        for number in range(8):
            seen = [proxy.client.get(f"/render?t={number}").headers["x-cache"] for _ in range(2)]
            assert seen == ["MISS", "HIT"]
        assert len(proxy.replicas[1].asked) == 8
        assert proxy.replicas[0].asked


def test_replicas_that_were_left_out_are_asked_if_there_is_no_other(tmp_path: Path):
    with proxying(tmp_path, 0, 0) as proxy:
        assert frames(proxy.client, 4) == [503] * 4
        for replica in proxy.replicas:
            replica.status = 200
        assert proxy.client.get("/ready").status_code == 200
        assert frames(proxy.client, 4) == [200] * 4


@pytest.mark.slow
def test_a_video_may_pause_for_longer_than_a_frame_takes(tmp_path: Path):
    with proxying(tmp_path, 503, 200) as proxy:
        full, sound = proxy.replicas
        t = 0
        while not full.asked:
            t += 1
            assert proxy.client.post("/render", json={"t": t}).status_code == 200
        sound.pause = 1.5 * READ_SECONDS
        for each in (t, t - 1):  # the first is asked of the full replica before
            response = proxy.client.post("/render/video", json={"t": each})
            assert (response.status_code, response.json()["status"]) == (200, 200)
        assert len(full.asked) > 1


@pytest.mark.parametrize("path", ["/render", "/render?t=0.5", "/render/video"])
def test_a_frame_that_took_too_long_is_not_drawn_again(tmp_path: Path, path: str):
    with proxying(tmp_path, 504, 504) as proxy:
        response = proxy.client.request("GET" if "?" in path else "POST", path)
        assert (response.status_code, response.headers["content-type"]) == (504, PROBLEM)
        assert "time limit" in response.json()["detail"]
        assert sum(len(replica.asked) for replica in proxy.replicas) == 1


def test_other_errors_are_those_of_the_replica(tmp_path: Path):
    with proxying(tmp_path, 404) as proxy:
        (replica,) = proxy.replicas
        for replica.status in (404, 409, 422, 500, 501):
            for method, path in (*REPEATABLE[:-1], *CHANGES):
                response = proxy.client.request(method, path)
                assert (response.status_code, response.json()["detail"]) == (replica.status, "from a replica")
                assert replica.asked.pop() == f"{method} {path}"
                assert not replica.asked


def test_without_any_replica_the_log_has_the_method_and_the_client_a_problem(tmp_path: Path):
    with proxying(tmp_path, 0, 0) as proxy:
        for number, (method, path) in enumerate((*REPEATABLE, *CHANGES)):
            response = proxy.client.request(method, path, headers={"X-Request-ID": f"{number}"})
            assert (response.status_code, response.headers["content-type"]) == (503, PROBLEM)
            assert (response.headers["retry-after"], response.headers["x-request-id"]) == ("1", f"{number}")
            entry = proxy.log(f"{number}")
            assert (entry["method"], entry["status"]) == (method, 503)


def test_a_large_body_is_refused_before_any_replica_is_asked(tmp_path: Path):
    with proxying(tmp_path, 200) as proxy:
        most = Settings.model_fields["max_body_bytes"].default
        assert proxy.client.post("/render", content=b" " * most).status_code == 200
        response = proxy.client.post("/render", content=b" " * (most + 1))
        assert (response.status_code, response.headers["content-type"]) == (413, PROBLEM)
        assert "1 MiB" in response.json()["detail"]
        assert proxy.client.post("/scenes?name=new", content=b" " * (most + 1)).status_code == 200
        assert proxy.replicas[0].asked == ["POST /render", "POST /scenes?name=new"]


@contextlib.contextmanager
def full_backlog() -> Iterator[tuple[Server, Replica]]:
    """A server that doesn't accept connections, and whose queue of them is full, until its loop is started."""
    replica = Replica()
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(Server(("127.0.0.1", 0), Handler))
        server.answer = replica.answer
        server.socket.listen(0)
        with contextlib.suppress(TimeoutError):
            while True:
                stack.enter_context(socket.create_connection(server.server_address[:2], timeout=0.2))  # pyright: ignore[reportArgumentType]
        yield server, replica


@pytest.mark.slow
@pytest.mark.parametrize(("method", "path"), REPEATABLE[:2])
def test_a_request_survives_a_connect_timeout_of_the_only_replica(tmp_path: Path, method: str, path: str):
    with full_backlog() as (server, replica), running_nginx(tmp_path, [server.server_port]) as client:

        def serve_after_timeout() -> None:
            wait_for(lambda: "timed out" in (tmp_path / "errors.log").read_text())
            server.serve_forever(poll_interval=0.01)

        thread = threading.Thread(target=serve_after_timeout, daemon=True)
        thread.start()
        assert client.request(method, path).status_code == 200
        assert replica.asked == [f"{method} {path}"]
        server.shutdown()
        thread.join()
