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


PARTS = ConstructorRegistry()
"""How tyro parses and prints them."""


@PARTS.primitive_rule
def _layer(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    return _spec("layers", LAYERS, LayerConfig) if _is_a(info.type, LayerConfig) else None


@PARTS.primitive_rule
def _support(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    return _spec("support", SUPPORTS, SupportConfig) if _is_a(info.type, SupportConfig) else None


def _is_a(given: Any, base: type) -> bool:
    return inspect.isclass(given) and issubclass(given, base)


def _spec(field: str, kinds: Mapping[str, type], base: type) -> PrimitiveConstructorSpec[Any]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="KIND[:NAME=VALUE,…]",
        instance_from_str=lambda words: _read(field, words[0], kinds),
        is_instance=lambda value: isinstance(value, base),
        str_from_instance=lambda part: [to_text(part)],
    )


def _read(field: str, word: str, kinds: Mapping[str, type]) -> Any:
    try:
        return from_plain(field, word, kinds)
    except InvalidInput as error:
        raise PartInvalid(str(error)) from error
