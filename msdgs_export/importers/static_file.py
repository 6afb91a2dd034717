"""Scene files of static scenes in float32, written from their arrays: messages of Protobuf take several times their
memory, and have a limit."""

from dataclasses import replace
from pathlib import Path

import onnx
from google.protobuf.message import Message as Protobuf

from msdgs_export.bake import Baked, Moving
from msdgs_export.importers.scene import against_files, pose_differences
from msdgs_export.jobs.write import properties, set_properties
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import build
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import CONSTANT_OUTPUTS, BakedScene
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.onnx.write import Message
from msdgs_serve.writing import replacing


class StaticSceneFile:
    """The scene file of a static scene, which is written from its arrays. The bytes are those of `build`."""

    def __init__(self, scene: BakedScene) -> None:
        self._arrays = {name: getattr(scene, name) for name in CONSTANT_OUTPUTS}
        none = {name: array[:0].copy() for name, array in self._arrays.items()}
        self._message = build(BASELINE, Baked(replace(scene, **none), Moving.none(), ()))
        for tensor in self._message.graph.initializer:
            if tensor.name in self._arrays:
                tensor.dims[0] = len(scene)
        for output in self._message.graph.output:
            if output.name in self._arrays:
                output.type.tensor_type.shape.dim[0].dim_value = len(scene)
        posed = (scene.static_means, scene.static_quats, scene.static_scales)
        self._posed = Gaussians(*posed, none["opacities"], none["sh"])

    def write(self, output: Path) -> BakedScene:
        """Write the scene file as `write_imported` does, in float32. It can be written once: opacities and SH are
        released before the file is opened and compared. Raises `SceneFileInvalid`."""
        with replacing(output) as temporary:
            with temporary.open("wb") as file:
                file.writelines(self._graph())
                self._arrays.clear()
                end = file.tell()
                file.writelines(self._metadata())
            session = DeformationSession(temporary)
            worst = pose_differences(session.gaussians(0.0), self._posed, session.scene.metadata.bounds)
            del session
            measured = properties(self._message)["measured_error"] | against_files(worst, times=1)
            set_properties(self._message, measured_error=measured)
            with temporary.open("r+b") as file:
                file.truncate(end)
                file.seek(end)
                file.writelines(self._metadata())
            return DeformationSession(temporary).scene  # opened again: its metadata has changed

    def _graph(self) -> list[bytes | memoryview]:
        """Everything but the metadata."""
        graph = self._message.graph
        fields = Message(
            (2, graph.name),
            *((5, self._tensor(each)) for each in graph.initializer),
            *((11, _encoded(each)) for each in graph.input),
            *((12, _encoded(each)) for each in graph.output),
        )
        return Message((1, self._message.ir_version), (2, self._message.producer_name), (7, fields)).parts

    def _metadata(self) -> list[bytes | memoryview]:
        """The end of the file."""
        opsets = ((8, _encoded(each)) for each in self._message.opset_import)
        return Message(*opsets, *((14, _encoded(each)) for each in self._message.metadata_props)).parts

    def _tensor(self, tensor: onnx.TensorProto) -> Message | memoryview:
        if tensor.name not in self._arrays:
            return _encoded(tensor)
        values = self._arrays[tensor.name].view("<f4").reshape(-1).view("u1").data
        return Message(*((1, size) for size in tensor.dims), (2, tensor.data_type), (8, tensor.name), (9, values))


def _encoded(message: Protobuf) -> memoryview:
    return memoryview(message.SerializeToString())
