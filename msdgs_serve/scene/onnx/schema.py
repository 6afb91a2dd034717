"""The messages of onnx.proto by field number: fields that are read, skipped or rejected in scene files.

Skipped fields don't affect the computation. They are not parsed and never passed to onnxruntime.
"""

from msdgs_serve.scene.onnx.wire import Field, Kind, Schema

MAX_NODES = 4096
MAX_CONSTANTS = 8192
MAX_PORTS = 64
"""Limit of inputs and of outputs of a graph."""
MAX_OPERANDS = 64
"""Limit of inputs and of outputs of a node."""
MAX_RANK = 8
MAX_ELEMENTS = 1 << 40
"""Limit of elements of an array, counting lengths of 0 as 1: huge lengths of empty arrays overflow in libraries."""
MAX_LISTED = 1 << 18
"""Limit of bytes of all lists of integers together, which are read one by one."""
MAX_PROPERTIES = 64
"""Limit of metadata entries of the model or a part of it."""
MAX_VALUE_INFOS = 8192

MODEL: Schema = {
    1: Field("ir_version", Kind.INTEGER),
    2: Field("producer_name", Kind.SKIPPED),
    3: Field("producer_version", Kind.SKIPPED),
    4: Field("domain", Kind.SKIPPED),
    5: Field("model_version", Kind.SKIPPED),
    6: Field("doc_string", Kind.SKIPPED),
    7: Field("graph", Kind.BYTES),
    8: Field("opset_import", Kind.BYTES, max_count=8),
    14: Field("metadata_props", Kind.BYTES, max_count=MAX_PROPERTIES),
    20: Field("training_info", Kind.REJECTED),
    25: Field("functions", Kind.REJECTED),
    26: Field("configuration", Kind.REJECTED),
}
OPSET: Schema = {1: Field("domain", Kind.NAME), 2: Field("version", Kind.INTEGER)}
PROPERTY: Schema = {1: Field("key", Kind.NAME), 2: Field("value", Kind.TEXT)}
GRAPH: Schema = {
    1: Field("node", Kind.BYTES, max_count=MAX_NODES),
    2: Field("name", Kind.SKIPPED),
    5: Field("initializer", Kind.BYTES, max_count=MAX_CONSTANTS),
    10: Field("doc_string", Kind.SKIPPED),
    11: Field("input", Kind.BYTES, max_count=MAX_PORTS),
    12: Field("output", Kind.BYTES, max_count=MAX_PORTS),
    13: Field("value_info", Kind.SKIPPED, max_count=MAX_VALUE_INFOS),
    14: Field("quantization_annotation", Kind.REJECTED),
    15: Field("sparse_initializer", Kind.REJECTED),
    16: Field("metadata_props", Kind.SKIPPED, max_count=MAX_PROPERTIES),
}
NODE: Schema = {
    1: Field("input", Kind.NAME, max_count=MAX_OPERANDS),
    2: Field("output", Kind.NAME, max_count=MAX_OPERANDS),
    3: Field("name", Kind.NAME),
    4: Field("op_type", Kind.NAME),
    5: Field("attribute", Kind.BYTES, max_count=16),
    6: Field("doc_string", Kind.SKIPPED),
    7: Field("domain", Kind.NAME),
    8: Field("overload", Kind.NAME),
    9: Field("metadata_props", Kind.SKIPPED, max_count=MAX_PROPERTIES),
    10: Field("device_configurations", Kind.REJECTED),
}
ATTRIBUTE: Schema = {
    1: Field("name", Kind.NAME),
    2: Field("f", Kind.REJECTED),
    3: Field("i", Kind.INTEGER),
    4: Field("s", Kind.REJECTED),
    5: Field("t", Kind.REJECTED),
    6: Field("g", Kind.REJECTED),
    7: Field("floats", Kind.REJECTED),
    8: Field("ints", Kind.INTEGER, max_count=MAX_RANK),
    9: Field("strings", Kind.REJECTED),
    10: Field("tensors", Kind.REJECTED),
    11: Field("graphs", Kind.REJECTED),
    13: Field("doc_string", Kind.SKIPPED),
    14: Field("tp", Kind.REJECTED),
    15: Field("type_protos", Kind.REJECTED),
    20: Field("type", Kind.ENUM),
    21: Field("ref_attr_name", Kind.REJECTED),
    22: Field("sparse_tensor", Kind.REJECTED),
    23: Field("sparse_tensors", Kind.REJECTED),
}
TENSOR: Schema = {
    1: Field("dims", Kind.INTEGER, max_count=MAX_RANK),
    2: Field("data_type", Kind.ENUM),
    3: Field("segment", Kind.REJECTED),
    4: Field("float_data", Kind.BYTES),
    5: Field("int32_data", Kind.BYTES),
    6: Field("string_data", Kind.REJECTED),
    7: Field("int64_data", Kind.REJECTED),
    8: Field("name", Kind.NAME),
    9: Field("raw_data", Kind.BYTES),
    10: Field("double_data", Kind.REJECTED),
    11: Field("uint64_data", Kind.REJECTED),
    12: Field("doc_string", Kind.SKIPPED),
    13: Field("external_data", Kind.REJECTED),
    14: Field("data_location", Kind.ENUM),
    16: Field("metadata_props", Kind.SKIPPED, max_count=MAX_PROPERTIES),
}
PORT: Schema = {
    1: Field("name", Kind.NAME),
    2: Field("type", Kind.BYTES),
    3: Field("doc_string", Kind.SKIPPED),
    4: Field("metadata_props", Kind.SKIPPED, max_count=MAX_PROPERTIES),
}
TYPE: Schema = {
    1: Field("tensor_type", Kind.BYTES),
    4: Field("sequence_type", Kind.REJECTED),
    5: Field("map_type", Kind.REJECTED),
    6: Field("denotation", Kind.SKIPPED),
    8: Field("sparse_tensor_type", Kind.REJECTED),
    9: Field("optional_type", Kind.REJECTED),
}
TENSOR_TYPE: Schema = {1: Field("elem_type", Kind.ENUM), 2: Field("shape", Kind.BYTES)}
TENSOR_SHAPE: Schema = {1: Field("dim", Kind.BYTES, max_count=MAX_RANK)}
DIMENSION: Schema = {
    1: Field("dim_value", Kind.INTEGER),
    2: Field("dim_param", Kind.NAME),
    3: Field("denotation", Kind.SKIPPED),
}
