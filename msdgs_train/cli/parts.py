"""Layers and supports as command-line values: `mlp:width=96,depth=2`."""

import inspect
from collections.abc import Mapping
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.parts import from_plain, to_text
from msdgs_train.layers.registry import LAYERS
from msdgs_train.supports.base import SupportConfig
from msdgs_train.supports.registry import SUPPORTS


class PartInvalid(MsdgsError):
    """An invalid layer or support in an option. Not a `ValueError`, which tyro would replace by its own message."""


OPTIONS: dict[type, tuple[str, Mapping[str, type]]] = {
    LayerConfig: ("layers", LAYERS),
    SupportConfig: ("support", SUPPORTS),
}
"""By base class, the option and the kinds that it accepts."""

PARTS = ConstructorRegistry()
"""The rules by which tyro parses and prints layers and supports."""


@PARTS.primitive_rule
def _part(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    base = next((base for base in OPTIONS if inspect.isclass(info.type) and issubclass(info.type, base)), None)
    if base is None:
        return None
    option, kinds = OPTIONS[base]
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="KIND[:NAME=VALUE,…]",
        instance_from_str=lambda words: _read(option, words[0], kinds),
        is_instance=lambda value: isinstance(value, base),
        str_from_instance=lambda part: [to_text(part)],
    )


def _read(option: str, word: str, kinds: Mapping[str, type]) -> Any:
    try:
        return from_plain(option, word, kinds)
    except InvalidInput as error:
        raise PartInvalid(str(error)) from error
