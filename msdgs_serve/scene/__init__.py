"""The shared vocabulary: what a scene, a camera and an error are. NumPy only; every other room imports it."""

from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput, MsdgsError, SceneFileInvalid, SceneNotFound
from msdgs_serve.scene.gaussians import Gaussians

__all__ = ["Camera", "Gaussians", "InvalidInput", "MsdgsError", "SceneFileInvalid", "SceneNotFound"]
