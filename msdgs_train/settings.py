"""What groups of settings and commands share: how the help shows options, and checks."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from msdgs_serve.scene.errors import InvalidInput

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
"""An option without a value, off unless it is given."""


def optional(metavar: str, aliases: list[str] | None = None) -> Any:
    """How the help shows an option that may be left out, and whose text says what happens then: without `None`."""

    def shown(default: str) -> str:
        return "" if default == "None" else f"(default: {default})"

    return tyro.conf.arg(metavar=metavar, aliases=aliases, help_behavior_hint=shown)


def require_seed(field: str, seed: object) -> None:
    """Raise `InvalidInput` unless `seed` is a whole number in [0, 2³¹), which torch, numpy and COLMAP take."""
    if type(seed) is not int or not 0 <= seed < 2**31:
        raise InvalidInput(field, "0 or more, below 2³¹", seed)


class Checked:
    """A frozen dataclass whose fields are checked when it is built."""

    def require(self, names: tuple[str, ...], expected: str, holds: Callable[[Any], bool]) -> None:
        """Raise `InvalidInput` naming the first of the fields `names` whose value doesn't hold."""
        for name in names:
            value = getattr(self, name)
            if not holds(value):
                raise InvalidInput(f"config.{name}", expected, value)

    def require_counts(self, *names: str, least: int = 1) -> None:
        """Whole numbers of `least` or more."""
        self.require(names, f"a whole number of {least} or more", lambda v: type(v) is int and v >= least)

    def require_fractions(self, *names: str) -> None:
        """Numbers in [0, 1]."""
        self.require(names, "in [0, 1]", lambda v: _is_number(v) and 0 <= v <= 1)

    def require_weights(self, *names: str) -> None:
        """Finite numbers of 0 or above."""
        self.require(names, "finite and 0 or above", lambda v: _is_number(v) and 0 <= v < math.inf)

    def require_positive(self, *names: str) -> None:
        """Finite numbers above 0."""
        self.require(names, "finite and above 0", lambda v: _is_number(v) and 0 < v < math.inf)

    def require_positive_or_none(self, *names: str) -> None:
        """Finite numbers above 0, or None."""
        self.require(names, "above 0, or not given", lambda v: v is None or (_is_number(v) and 0 < v < math.inf))

    def names(self) -> tuple[str, ...]:
        """Names of all fields."""
        return tuple(item.name for item in dataclasses.fields(self))  # type: ignore[arg-type]


@dataclass(frozen=True)
class SystemConfig(Checked):
    """Settings of one system alone; a system that has some derives from it, with names that no other group has."""


OWN_SETTINGS: dict[str, type[SystemConfig]] = {}
"""Their types by the name of the system, of those that are registered."""


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)
