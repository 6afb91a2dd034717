"""A replacement of viser for tests of the viewer without a browser."""

import contextlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from msdgs_serve.scene import Camera, quaternion
from msdgs_train.viewer import viewer as viewer_module


class PageClient:
    """A browser with a camera; `images` are all images that it has received, [H, W, 3] uint8."""

    def __init__(self, camera: Camera) -> None:
        self.client_id = -1
        self.images: list[np.ndarray] = []
        self.scene = SimpleNamespace(set_background_image=self._receive)
        self.camera = SimpleNamespace(look_at=np.zeros(3), up_direction=np.zeros(3))
        self.look_from(camera)

    def look_from(self, camera: Camera) -> None:
        """With an image of the camera's size; its principal point must be in the middle."""
        self.camera.wxyz = quaternion.from_matrix(camera.camera_to_world[:3, :3])
        self.camera.position = np.array(camera.position)
        self.camera.fov = 2 * np.arctan(camera.height / (2 * camera.fy))
        self.camera.image_width, self.camera.image_height = camera.width, camera.height

    def _receive(self, pixels: np.ndarray, **encoding: Any) -> None:
        self.images.append(pixels)


class PageServer:
    """The parts of `viser.ViserServer` that a viewer uses; controls are kept by their labels."""

    def __init__(self) -> None:
        self.clients: dict[int, PageClient] = {}
        self.controls: dict[str, SimpleNamespace] = {}
        self.texts: list[SimpleNamespace] = []
        self.initial_camera = SimpleNamespace()
        self.scene = SimpleNamespace(set_up_direction=lambda up: None)
        self.gui = SimpleNamespace(
            add_markdown=self._add_text,
            add_slider=lambda label, low, high, step, value, **_: self._add(label, value, limits=(low, high, step)),
            add_checkbox=lambda label, value, **_: self._add(label, value),
            add_dropdown=lambda label, options, **_: self._add(label, options[0]),
            add_folder=lambda label: contextlib.nullcontext(),
        )

    def get_port(self) -> int:
        return 8080

    def get_clients(self) -> dict[int, PageClient]:
        for number, client in self.clients.items():
            client.client_id = number
        return dict(self.clients)

    def stop(self) -> None:
        self.clients.clear()

    def _add(self, label: str, value: Any, **more: Any) -> SimpleNamespace:
        self.controls[label] = SimpleNamespace(value=value, **more)
        return self.controls[label]

    def _add_text(self, content: str) -> SimpleNamespace:
        self.texts.append(SimpleNamespace(content=content))
        return self.texts[-1]


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> PageServer:
    """Replace viser; returns the server of all viewers."""
    server = PageServer()
    monkeypatch.setattr(viewer_module, "_serve", lambda host, port: server)
    return server
