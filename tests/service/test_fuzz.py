"""Random bodies: refused or rendered, never a crash and never a 500.

`MSDGS_FUZZ=10000 pytest tests/service/test_fuzz.py -n 0` tries that many of each in place of a few for every day.
"""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.service.test_api_poison import FRAME, MATRIX, ORBIT, check_problem
from tests.support.scene_files import write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow

EVERY_DAY = 300
CASES = int(os.environ.get("MSDGS_FUZZ", EVERY_DAY))
SETTINGS = settings(
    max_examples=CASES,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)

NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True), st.integers(), st.sampled_from([0, -1, 1e999, 10**400, 1e-320])
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=20)),
    lambda inner: st.one_of(st.lists(inner, max_size=5), st.dictionaries(st.text(max_size=10), inner, max_size=4)),
    max_leaves=12,
)
KEYS = ["scene", "camera", "t", "width", "height", "format", "quality", "channels", "background", "shutter", "x"]
INNER = ["type", "azimuth", "elevation", "distance", "target", "up", "eye", "fov_y", "fx", "camera_to_world", "open"]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    path = write_scene(tmp_path_factory.mktemp("scenes") / "balls.onnx")
    with serving(path, max_pixels=64 * 64, max_samples=4, max_batch=4) as client:
        yield client


@SETTINGS
@given(
    keys=st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=4),
    inner=st.dictionaries(st.sampled_from(INNER), VALUES, max_size=3),
    camera=st.sampled_from([ORBIT, MATRIX]),
)
def test_random_bodies_are_refused_or_drawn(
    client: httpx.Client, keys: dict[str, Any], inner: dict[str, Any], camera: dict[str, Any]
):
    body = {**FRAME, "camera": {**camera, **inner}, **keys}
    text = json.dumps(body).replace("Infinity", "1e999")
    for path, content in (("/render", text), ("/render/batch", f'{{"frames": [{text}]}}')):
        response = client.post(path, content=content, headers={"Content-Type": "application/json"})
        assert response.status_code in (200, 400, 404, 422), (content, response.text)
        if response.status_code != 200:
            check_problem(response)
        elif path == "/render/batch":
            assert json.loads(response.content)["status"] in (200, 404, 422), (content, response.text)


@SETTINGS
@given(content=st.binary(max_size=300))
def test_random_bytes_are_refused(client: httpx.Client, content: bytes):
    response = client.post("/render", content=content, headers={"Content-Type": "application/json"})
    assert response.status_code in (400, 422)
    check_problem(response)


def test_the_service_lives_on(client: httpx.Client, tmp_path: Path):
    assert client.post("/render", json=FRAME).status_code == 200
