"""What a page shows of a scene: facts of its file, and the view that it opens with."""

from typing import Any

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import Framing
from msdgs_serve.scene.metadata import SceneMetadata


def described(session: DeformationSession, metadata: SceneMetadata, view: Framing) -> dict[str, Any]:
    """JSON values for a scene, with `metadata` and its default `view` in the user's world."""
    scene = session.scene
    return vars(metadata) | {
        "cameras": [camera.to_plain() for camera in metadata.cameras],
        "scene_to_world": scene.metadata.scene_to_world.to_plain(),
        "steps": session.max_steps,
        "gaussians": {"moving": scene.moving_count, "static": scene.static_count, "total": len(scene)},
        "changes": scene.changes,
        "motion": scene.has_motion,
        "view": vars(view) | {"target": view.target.tolist(), "up": view.up.tolist()},
        "sha256": session.sha256,
    }
