"""Packages that a single switch needs."""

from msdgs_serve.scene.errors import MsdgsError


class ExtraMissing(MsdgsError):
    """A switch was given whose package isn't installed."""

    def __init__(self, switch: str, package: str, extra: str) -> None:
        super().__init__(f"{switch} needs {package}: pip install 'msdgs[{extra}]'")
