"""Plan `prefix:k`: the first k layers as trained, where the rest moves nothing visible."""

from dataclasses import replace

import onnx

from export.bake import Baked
from export.plans.network import network
from msdgs_serve.scene.errors import InvalidInput


def prefix(baked: Baked, count: int) -> onnx.ModelProto:
    """The scene with its first `count` layers. Raises `InvalidInput` where it hasn't as many."""
    if count > len(baked.layers):
        raise InvalidInput("plan", f"prefix:k with k from 1 to {len(baked.layers)}, this model's layers", count)
    metadata = replace(baked.scene.metadata, layers=baked.scene.metadata.layers[:count])
    scene = replace(baked.scene, metadata=metadata)
    return network(replace(baked, layers=baked.layers[:count], scene=scene), f"prefix:{count}")
