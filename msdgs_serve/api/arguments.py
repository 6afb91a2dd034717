"""The command line of `msdgs-serve`: an option for each setting."""

from argparse import SUPPRESS, ArgumentParser, BooleanOptionalAction, RawDescriptionHelpFormatter
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from msdgs_serve.api.settings import (
    CommonSettings,
    LimitSettings,
    LogSettings,
    Settings,
    UploadSettings,
    split_list,
)

PROGRAM = "msdgs-serve"
GROUPS = {
    "common options": CommonSettings,
    "limits of requests and scenes": LimitSettings,
    "uploads": UploadSettings,
    "logging": LogSettings,
}
OPTION_WIDTH = 36
"""Most characters of an option beside its description."""

DESCRIPTION = """\
Serve scenes over HTTP: POST /render returns a frame for any camera and any time.

  msdgs-serve scene.onnx                  one scene
  msdgs-serve scenes/ --port 9000         every .onnx file of a folder; files may be added, changed and removed
  msdgs-serve --compile                   compile the kernels for later starts, and exit
  MSDGS_SCENES=scenes/ msdgs-serve        every option is also an environment variable with the prefix MSDGS_

`msdgs-export model.pt` writes a scene file. The running service documents its API at /docs.
"""


def read_settings(arguments: Sequence[str]) -> Settings:
    """Return the settings of a command line and of the environment.

    Raises pydantic's `ValidationError` for a wrong value; ends the program with status 2 for an unknown option.
    """
    return Settings(**vars(_parser().parse_args(arguments)))


def _parser() -> ArgumentParser:
    """Return a parser that leaves out options that aren't given."""
    parser = ArgumentParser(
        PROGRAM,
        usage="%(prog)s [-h] [OPTIONS] [SCENE ...]",
        description=DESCRIPTION,
        formatter_class=partial(RawDescriptionHelpFormatter, max_help_position=OPTION_WIDTH),
        argument_default=SUPPRESS,
        allow_abbrev=False,
    )
    scenes = Settings.model_fields["scenes"].description
    parser.add_argument("scenes", nargs="*", metavar="SCENE", default=SUPPRESS, help=scenes)
    for title, settings in GROUPS.items():
        group = parser.add_argument_group(title)
        for name, field in settings.model_fields.items():
            group.add_argument(f"--{name.replace('_', '-')}", help=_help(field), **_value(name, field.annotation))
    return parser


def _help(field: FieldInfo) -> str:
    """Return the description of a setting and its default, if that is a number or a text."""
    default = field.default
    if isinstance(default, bool) or default == "" or not isinstance(default, int | float | str):
        return field.description or ""
    return f"{field.description} (default: {f'{default:g}' if isinstance(default, float) else default})"


def _value(name: str, annotation: Any) -> dict[str, Any]:
    """Return how an option takes its value, which pydantic converts: argparse's keywords."""
    if annotation is bool:
        return {"action": BooleanOptionalAction}
    kinds = get_args(annotation)  # of X | None, list[X] and Literal
    if get_origin(annotation) is Literal:
        return {"metavar": f"{{{','.join(kinds)}}}"}
    metavar = (kinds[0] if kinds else annotation).__name__.upper()
    if get_origin(annotation) is list:
        return {"metavar": metavar, "action": "extend", "type": partial(split_list, name)}
    return {"metavar": metavar}
