"""The messages of onnx.proto by number of field: what a scene file may have, what is skipped, what is refused.

Skipped fields say nothing about what is computed. They are not looked at and never reach onnxruntime.
"""

from msdgs_serve.scene.onnx.wire import Field, Kind, Schema

MAX_NODES = 4096
MAX_CONSTANTS = 8192
MAX_PORTS = 64
"""Inputs and outputs of a graph."""
MAX_OPERANDS = 64
"""Inputs and outputs of a node."""
MAX_RANK = 8
MAX_ELEMENTS = 1 << 40
"""Of an array, lengths of 0 counted as 1: an empty one of huge lengths overflows in libraries."""
MAX_PROPERTIES = 64
"""Entries of metadata, of the model or any part of it."""
MAX_VALUE_INFOS = 8192

MODEL: Schema = {
    1: Field("ir_version", Kind.INTEGER),
    2: Field("producer_name", Kind.SKIPPED),
    3: Field("producer_version", Kind.SKIPPED),
    4: Field("domain", Kind.SKIPPED),
    5: Field("model_version", Kind.SKIPPED),
    6: Field("doc_string", Kind.SKIPPED),
    7: Field("graph", Kind.BYTES),
    8: Field("opset_import", Kind.BYTES, most=8),
    14: Field("metadata_props", Kind.BYTES, most=MAX_PROPERTIES),
    20: Field("training_info", Kind.REFUSED),
    25: Field("functions", Kind.REFUSED),
    26: Field("configuration", Kind.REFUSED),
}
OPSET: Schema = {1: Field("domain", Kind.NAME), 2: Field("version", Kind.INTEGER)}
PROPERTY: Schema = {1: Field("key", Kind.NAME), 2: Field("value", Kind.TEXT)}
GRAPH: Schema = {
    1: Field("node", Kind.BYTES, most=MAX_NODES),
    2: Field("name", Kind.SKIPPED),
    5: Field("initializer", Kind.BYTES, most=MAX_CONSTANTS),
    10: Field("doc_string", Kind.SKIPPED),
    11: Field("input", Kind.BYTES, most=MAX_PORTS),
    12: Field("output", Kind.BYTES, most=MAX_PORTS),
    13: Field("value_info", Kind.SKIPPED, most=MAX_VALUE_INFOS),
    14: Field("quantization_annotation", Kind.REFUSED),
    15: Field("sparse_initializer", Kind.REFUSED),
    16: Field("metadata_props", Kind.SKIPPED, most=MAX_PROPERTIES),
}
NODE: Schema = {
    1: Field("input", Kind.NAME, most=MAX_OPERANDS),
    2: Field("output", Kind.NAME, most=MAX_OPERANDS),
    3: Field("name", Kind.NAME),
    4: Field("op_type", Kind.NAME),
    5: Field("attribute", Kind.BYTES, most=16),
    6: Field("doc_string", Kind.SKIPPED),
    7: Field("domain", Kind.NAME),
    8: Field("overload", Kind.NAME),
    9: Field("metadata_props", Kind.SKIPPED, most=MAX_PROPERTIES),
    10: Field("device_configurations", Kind.REFUSED),
}
ATTRIBUTE: Schema = {
    1: Field("name", Kind.NAME),
    2: Field("f", Kind.REFUSED),
    3: Field("i", Kind.INTEGER),
    4: Field("s", Kind.REFUSED),
    5: Field("t", Kind.REFUSED),
    6: Field("g", Kind.REFUSED),
    7: Field("floats", Kind.REFUSED),
    8: Field("ints", Kind.INTEGER, most=MAX_RANK),
    9: Field("strings", Kind.REFUSED),
    10: Field("tensors", Kind.REFUSED),
    11: Field("graphs", Kind.REFUSED),
    13: Field("doc_string", Kind.SKIPPED),
    14: Field("tp", Kind.REFUSED),
    15: Field("type_protos", Kind.REFUSED),
    20: Field("type", Kind.ENUM),
    21: Field("ref_attr_name", Kind.REFUSED),
    22: Field("sparse_tensor", Kind.REFUSED),
    23: Field("sparse_tensors", Kind.REFUSED),
}
TENSOR: Schema = {
    1: Field("dims", Kind.INTEGER, most=MAX_RANK),
    2: Field("data_type", Kind.ENUM),
    3: Field("segment", Kind.REFUSED),
    4: Field("float_data", Kind.REFUSED),
    5: Field("int32_data", Kind.REFUSED),
    6: Field("string_data", Kind.REFUSED),
    7: Field("int64_data", Kind.REFUSED),
    8: Field("name", Kind.NAME),
    9: Field("raw_data", Kind.BYTES),
    10: Field("double_data", Kind.REFUSED),
    11: Field("uint64_data", Kind.REFUSED),
    12: Field("doc_string", Kind.SKIPPED),
    13: Field("external_data", Kind.REFUSED),
    14: Field("data_location", Kind.ENUM),
    16: Field("metadata_props", Kind.SKIPPED, most=MAX_PROPERTIES),
}
PORT: Schema = {
    1: Field("name", Kind.NAME),
    2: Field("type", Kind.BYTES),
    3: Field("doc_string", Kind.SKIPPED),
    4: Field("metadata_props", Kind.SKIPPED, most=MAX_PROPERTIES),
}
TYPE: Schema = {
    1: Field("tensor_type", Kind.BYTES),
    4: Field("sequence_type", Kind.REFUSED),
    5: Field("map_type", Kind.REFUSED),
    6: Field("denotation", Kind.SKIPPED),
    8: Field("sparse_tensor_type", Kind.REFUSED),
    9: Field("optional_type", Kind.REFUSED),
}
TENSOR_TYPE: Schema = {1: Field("elem_type", Kind.ENUM), 2: Field("shape", Kind.BYTES)}
TENSOR_SHAPE: Schema = {1: Field("dim", Kind.BYTES, most=MAX_RANK)}
DIMENSION: Schema = {
    1: Field("dim_value", Kind.INTEGER),
    2: Field("dim_param", Kind.NAME),
    3: Field("denotation", Kind.SKIPPED),
}
