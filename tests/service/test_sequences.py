"""Random sequences of requests: no frame depends on those before it."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msdgs_serve.renderer import Renderer
from tests.support.scene_files import write_scene
from tests.support.service import eventually, in_this_process, serving

pytestmark = [in_this_process, pytest.mark.slow]

NAME = "balls"
VERSIONS = [
    {"background": (0.25, 0.5, 0.75), "steps": True},
    {"background": (0.5, 0.25, 0.0), "steps": True, "static_color": (0.0, 0.0, 1.0)},
    {"background": (1.0, 1.0, 1.0), "steps": True, "moving": 2},
]
"""Of the scene's file. In the last, more Gaussians move than a frame sequence allows."""

requests = st.fixed_dictionaries(
    {
        "camera": st.fixed_dictionaries(
            {"type": st.just("orbit"), "azimuth": st.sampled_from([0, 30]), "elevation": st.sampled_from([0, 30])}
        ),
        "t": st.sampled_from([0.0, 0.2, 0.5, 0.9]),
        "format": st.sampled_from(["npy", "png"]),
    },
    optional={
        "width": st.sampled_from([24, 61]),
        "height": st.sampled_from([16, 53]),
        "region": st.sampled_from([[0, 0, 9, 9], [3, 1, 15, 14]]),
        "background": st.sampled_from(["scene", "transparent", [0.1, 0.9, 0.4]]),
        "steps": st.sampled_from([0, 0.5, 1]),
        "shutter": st.just({"open": 0.0, "close": 0.1, "samples": 2}),
        "channels": st.sampled_from([["color"], ["depth"]]),
    },
)
actions = st.lists(st.one_of(requests, requests, requests, st.sampled_from(range(len(VERSIONS)))), max_size=24)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / f"{NAME}.onnx", **VERSIONS[0])
    return folder


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer()


@pytest.fixture(scope="module")
def services(folder: Path, renderer: Renderer) -> Iterator[list[httpx.Client]]:
    """A service that keeps what stands still for the next frame, and one that doesn't."""
    with serving(folder, renderer=renderer) as one, serving(folder, renderer=Renderer(sequence_bytes=0)) as other:
        yield [one, other]


def test_no_frame_differs_from_a_fresh_one(folder: Path, renderer: Renderer, services: list[httpx.Client]):
    @given(actions)
    def compare(sequence: list[dict[str, Any] | int]):
        replace_scene(folder, VERSIONS[0], services)
        for action in sequence:
            if isinstance(action, int):
                replace_scene(folder, VERSIONS[action], services)
            else:
                got, expected = (client.post("/render", json=action) for client in services)
                assert (got.status_code, got.content) == (expected.status_code, expected.content)
                answers.add(got.status_code)

    answers = set[int]()
    compare()
    assert 200 in answers
    assert renderer.sequences.use.drawn > 0


def replace_scene(folder: Path, version: dict[str, Any], services: list[httpx.Client]) -> None:
    """Replace the scene's file, and wait until both services have the new one."""
    os.replace(write_scene(folder.parent / "next.onnx", **version), folder / f"{NAME}.onnx")
    for client in services:
        eventually(lambda client=client: background(client) == version["background"])


def background(client: httpx.Client) -> tuple[float, ...]:
    return tuple(client.get(f"/scenes/{NAME}").json()["background"])
