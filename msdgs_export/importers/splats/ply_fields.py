"""What is done with each property of a PLY, by name: docs/formats.md shows the tables."""

from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from msdgs_export.importers.errors import ImportFailed
from msdgs_serve.scene.fields import FieldTable

AS_GAUSSIANS = "render or bake it there to PLYs of plain Gaussians, one a time if it moves"

REFUSED = {
    "f_offset_*": "anchors of Scaffold-GS and its successors, of which a network makes Gaussians for each view",
    "f_anchor_feat_*": "anchors of Scaffold-GS and its successors, of which a network makes Gaussians for each view",
    "f_t_*": "features of SpacetimeGaussians' full model, of which a network makes colors; its lite model can be read",
    "f_dc_*": "more than three colors, features of which a network makes them",
    "t": "a time of each Gaussian, as 4D Gaussian splatting has it",
    "time": "a time of each Gaussian, as 4D Gaussian splatting has it",
    "t_scale": "a duration of each Gaussian, as 4D Gaussian splatting has it",
    "scale_t": "a duration of each Gaussian, as 4D Gaussian splatting has it",
    "scaling_t": "a duration of each Gaussian, as 4D Gaussian splatting has it",
    "rot_r_*": "second rotations of 4D Gaussian splatting",
    "rotation_r_*": "second rotations of 4D Gaussian splatting",
    "velocity_*": "velocities, whose unit of time the file doesn't say",
    "delta_vertex_*": "frames of Brush's animated PLY",
    "beta": "shapes of Beta splatting, which aren't Gaussians",
    "sb_params_*": "colors of Beta splatting, which aren't SH",
    "sh0_*": "colors of Beta splatting, which has no `f_dc_0`",
    "f_asg_*": "colors of Spec-Gaussian, of which a network makes them",
    "nu_degree": "shapes of Student splatting, which aren't Gaussians",
}
"""Properties and elements without which the scene would be another, and what they are."""

PLY = FieldTable(
    "PLY",
    {
        **dict.fromkeys(("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_*", "opacity"), "applied"),
        **dict.fromkeys(("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"), "applied"),
        **dict.fromkeys(("red", "green", "blue", "filter_3D"), "applied"),
        **dict.fromkeys(("motion_*", "omega_*", "trbf_center", "trbf_scale"), "applied"),
        **dict.fromkeys(("packed_position", "packed_rotation", "packed_scale", "packed_color"), "applied"),
        **dict.fromkeys(("min_*", "max_*"), "applied"),
        **dict.fromkeys(REFUSED, "refused"),
        **dict.fromkeys(("nx", "ny", "nz", "alpha", "intensity", "confidence", "id"), "harmless"),
        **dict.fromkeys(("semantic_*", "feature_*", "language_feature_*", "ins_feat_*", "obj_dc_*"), "harmless"),
        "fea_*": "harmless",
        **dict.fromkeys(("object_id", "label", "segment_id", "Original_cloud_index"), "harmless"),
        **dict.fromkeys(("face", "edge", "extrinsic", "intrinsic", "image_size", "frame"), "harmless"),
        **dict.fromkeys(("disparity", "color_space", "version"), "harmless"),
    },
)
"""Properties, of all elements, and elements that aren't needed."""


def checked_fields(file: Path, names: Iterable[str]) -> list[str]:
    """Warnings that name fields of no table. Raises `ImportFailed` naming one that is refused."""
    names = list(names)
    for name in names:
        if PLY.use(name) == "refused":
            what = next(text for pattern, text in REFUSED.items() if fnmatchcase(name, pattern))
            raise ImportFailed(file, f"has `{name}`, {what}; {AS_GAUSSIANS}")
    unlisted = PLY.unlisted(names)
    shown = ", ".join(f"`{name}`" for name in unlisted[:8]) + (f" and {len(unlisted) - 8} more" * (len(unlisted) > 8))
    what = f"{shown}: no known part of a splat, and left out; if it changes the image, {AS_GAUSSIANS}"
    return [what] if unlisted else []
