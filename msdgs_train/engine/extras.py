"""The error for an optional package that isn't installed."""

from msdgs_serve.scene.errors import MsdgsError


class ExtraMissing(MsdgsError):
    """An option was given whose package isn't installed."""

    def __init__(self, option: str, package: str, extra: str) -> None:
        super().__init__(f"{option} needs {package}: pip install 'msdgs[{extra}]'")
