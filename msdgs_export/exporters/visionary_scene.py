"""The `scene.json` that opens a model in Visionary's editor: its transform and the background."""

from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from msdgs_serve.framing import scene_framing
from msdgs_serve.scene.metadata import SceneMetadata

VERSION = 1


def visionary_scene(model: str, metadata: SceneMetadata) -> dict[str, Any]:
    """A scene of one model, the name of a file beside it.

    The model is rotated so that up is y, as in three.js, scaled to units of the world, and the target of its cameras is
    moved to the origin.
    Rotations are Euler angles in radians, intrinsic, in the order XYZ. The keys are those of Visionary's example.
    """
    view, scale = scene_framing(metadata), metadata.scene_to_world.scale
    rotation = Rotation.align_vectors([[0.0, 1.0, 0.0]], view.up[None])[0]
    transform = {
        "position": (-scale * rotation.apply(view.target)).tolist(),
        "rotationEulerRad": np.asarray(rotation.as_euler("XYZ")).tolist(),
        "scale": [scale] * 3,
    }
    asset = {"name": model, "type": "onnx", "path": model, "dynamic": True, "transform": transform}
    return {
        "version": VERSION,
        "meta": {"app": "msdgs", "createdAt": datetime.now(UTC).isoformat(timespec="milliseconds")},
        "env": {"bgColor": [*metadata.background, 1.0], "gaussianScale": 1.0},
        "assets": [asset],
    }
