"""Entry points of the installed commands: the heavy modules are imported once the process is prepared."""

from msdgs_serve.process import begin


def to_onnx() -> int:
    """`msdgs-export`; returns the exit status."""
    begin()
    from msdgs_export.cli.to_onnx import command

    return command()


def convert() -> int:
    """`msdgs-convert`; returns the exit status."""
    begin()
    from msdgs_export.cli.convert import command

    return command()


def stability() -> int:
    """`msdgs-stability`; returns the exit status."""
    begin()
    from msdgs_export.cli.stability import command

    return command()
