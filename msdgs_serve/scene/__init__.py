"""Shared types: scenes, cameras, Gaussians and errors. Depends on NumPy only; all other packages import it."""

from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput, MsdgsError, SceneFileInvalid, SceneNotFound
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.region import Region

__all__ = ["Camera", "Gaussians", "InvalidInput", "MsdgsError", "Region", "SceneFileInvalid", "SceneNotFound"]
