"""The OpenAPI document held against the service by schemathesis: whatever it allows is answered as it says.

`MSDGS_FUZZ=10000 pytest tests/service/test_openapi.py -n 0` runs that many cases in place of a few for every day.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import hypothesis
import pytest
import schemathesis
from schemathesis.specs.openapi.checks import positive_data_acceptance

from tests.support.scene_files import write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow

EVERY_DAY = 200
# JSON Schema can't say which times and cameras a scene has, nor which fields go together: such requests are refused
NOT_EXPRESSIBLE = [positive_data_acceptance]
CASES = int(os.environ.get("MSDGS_FUZZ", EVERY_DAY))


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / "balls.onnx")
    with serving(folder, uploads=True, max_pixels=64 * 64, max_samples=4, max_batch=4, log_level="error") as client:
        yield client


def operations(client: httpx.Client) -> list[Any]:
    """Of the document, those that end the scene left out."""
    schema = schemathesis.openapi.from_url(f"{str(client.base_url).rstrip('/')}/openapi.json")
    found = [result.ok() for result in schema.get_all_operations()]  # pyright: ignore[reportAttributeAccessIssue]
    return [operation for operation in found if operation.method != "delete"]


def test_every_call_answers_as_the_document_says(client: httpx.Client):
    every = operations(client)
    assert len(every) == 11
    for operation in every:

        @hypothesis.settings(
            max_examples=max(1, -(-CASES // len(every))),
            deadline=None,
            database=None,
            suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.filter_too_much],
            derandomize=True,
        )
        @hypothesis.given(case=operation.as_strategy())
        def check(case: schemathesis.Case) -> None:
            case.call_and_validate(excluded_checks=NOT_EXPRESSIBLE)

        check()


def test_the_scene_is_still_served(client: httpx.Client, tmp_path: Path):
    body = {"camera": {"type": "orbit", "azimuth": 0, "elevation": 0}, "t": 0, "width": 16, "scene": "balls"}
    assert client.post("/render", json=body).status_code == 200
