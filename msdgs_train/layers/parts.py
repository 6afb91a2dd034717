"""Parts of a model as plain values and as text: {"kind": "mlp", "width": 96} and `mlp:width=96`."""

import ast
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, TypeVar

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers.plugins import load_plugins


class Part(Protocol):
    """A frozen dataclass of settings with the name of its kind."""

    kind: ClassVar[str]


P = TypeVar("P", bound=Part)

SWITCHES = {"true": True, "false": False}


def to_plain(part: Part) -> dict[str, Any]:
    """The kind and all settings, ready for JSON."""
    values = dataclasses.asdict(part)  # type: ignore[arg-type]
    return {"kind": part.kind} | {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def from_plain(field: str, value: Any, kinds: Mapping[str, type[P]]) -> P:
    """A part from plain values, from text, or the part itself.

    Raises `InvalidInput` naming `field` for a kind or a setting that isn't known.
    """
    if isinstance(value, tuple(kinds.values())):
        return value  # type: ignore[return-value]
    settings = dict(value) if isinstance(value, Mapping) else parse(field, value)
    kind = settings.pop("kind", None)
    if kind not in kinds:
        load_plugins()
    if not isinstance(kind, str) or kind not in kinds:
        expected = f"of a known kind ({', '.join(kinds)}); others come with --plugin MODULE"
        raise InvalidInput(field, expected, kind)
    known = {item.name: item for item in dataclasses.fields(kinds[kind])}  # type: ignore[arg-type]
    for name, setting in settings.items():
        if name not in known:
            raise InvalidInput(field, f"made of settings of {kind} ({', '.join(known)})", f"`{name}`")
        settings[name] = _checked(f"{field}.{name}", setting, known[name].default)
    return kinds[kind](**settings)


def parse(field: str, text: Any) -> dict[str, Any]:
    """`kind:name=value,name=value` as plain values; values are Python literals, or words without quotes."""
    if not isinstance(text, str):
        raise InvalidInput(field, "a kind with its settings, as in mlp:width=96", text)
    kind, _, rest = text.partition(":")
    settings: dict[str, Any] = {"kind": kind}
    try:
        call = ast.parse(f"f({rest})", mode="eval").body
        assert isinstance(call, ast.Call)
        if call.args:
            raise ValueError("a value without a name")
        for keyword in call.keywords:
            assert keyword.arg is not None
            value = keyword.value
            settings[keyword.arg] = value.id if isinstance(value, ast.Name) else ast.literal_eval(value)
    except (SyntaxError, ValueError, AssertionError) as error:
        raise InvalidInput(field, "a kind with its settings, as in mlp:width=96,depth=2", text) from error
    return settings


def to_text(part: Part) -> str:
    """`kind:name=value,…` with the settings that differ from their defaults."""
    changed = [
        f"{item.name}={getattr(part, item.name)!r}"
        for item in dataclasses.fields(part)  # type: ignore[arg-type]
        if getattr(part, item.name) != item.default
    ]
    return ":".join([part.kind, ",".join(changed)]) if changed else part.kind


def _checked(field: str, value: Any, default: Any) -> Any:
    """A value of the type of the default; a whole number does for a float, a list for a tuple, a word for a switch."""
    if isinstance(default, bool) and str(value).lower() in SWITCHES:
        return SWITCHES[str(value).lower()]
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if isinstance(default, tuple) and isinstance(value, list):
        return tuple(value)
    if type(value) is not type(default):
        raise InvalidInput(field, f"of type {type(default).__name__}", value)
    return value
