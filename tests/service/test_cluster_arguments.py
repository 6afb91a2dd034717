"""Arguments of the service on Ray Serve, which are the settings."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from msdgs_serve.cluster import WITHOUT_EFFECT, read_arguments
from msdgs_serve.scene import InvalidInput


def test_arguments_are_settings_replicas_and_cores():
    given = {"scenes": "/a:/b.onnx", "cors_origins": "https://a.org,https://b.org", "replicas": "4", "cores": "8"}
    settings, replicas, cores = read_arguments({**given, "uploads": "true", "queued_renders": "3"})
    assert (settings.scenes, replicas, cores) == ([Path("/a"), Path("/b.onnx")], 4, 8)
    assert settings.cors_origins == ["https://a.org", "https://b.org"]
    assert (settings.uploads, settings.queued_renders, settings.threads) == (True, 3, 8)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({}, "scenes"),
        ({"scenes": ""}, "scenes"),
        ({"scene": "/a"}, "scene"),
        ({"scenes": "/a", "queued_render": "3"}, "queued_render"),
        ({"scenes": "/a", "replicas": "many"}, "replicas"),
        ({"scenes": "/a", "cores": "0"}, "cores"),
        *(({"scenes": "/a", name: "8"}, name) for name in WITHOUT_EFFECT),
    ],
)
def test_a_wrong_argument_is_named(arguments: dict[str, str], name: str):
    with pytest.raises(InvalidInput) as error:
        read_arguments(arguments)
    assert error.value.field == name


def test_a_wrong_value_is_named():
    with pytest.raises(ValidationError, match="queued_renders"):
        read_arguments({"scenes": "/a", "queued_renders": "few"})
