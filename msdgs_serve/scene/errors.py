"""Domain errors. `msdgs_serve.api.errors` maps them to HTTP statuses.

MsdgsError
├── InvalidInput      an argument is invalid; `field` names it
├── SceneNotFound     there is no scene of that name
└── SceneFileInvalid  a scene file violates the contract; `field` names the part of it
"""

import unicodedata


class MsdgsError(Exception):
    """Base of all errors that this project raises."""


class InvalidInput(MsdgsError, ValueError):
    """An argument is invalid, as in "`camera.fov_y` must be in (0, 180) degrees, got 190"."""

    def __init__(self, field: str, expected: str, got: object) -> None:
        super().__init__(f"`{field}` must be {expected}, got {got}")
        self.field = field
        self.expected = expected
        self.got = got

    def renamed(self, field: str) -> "InvalidInput":
        """Return the error with another name of the field, such as its place in a whole request."""
        return InvalidInput(field, self.expected, self.got)


class SceneNotFound(MsdgsError, KeyError):
    """No scene of this name is being served."""

    def __init__(self, name: str, known: list[str]) -> None:
        super().__init__(
            f"no scene `{name}`; known scenes: {', '.join(known) or 'none'}{_spelled_otherwise(name, known)}"
        )
        self.name = name

    def __str__(self) -> str:
        return self.args[0]


class SceneFileInvalid(MsdgsError):
    """A scene file violates its contract: a part is missing, invalid or contradictory."""

    def __init__(self, file: str, field: str, problem: str, details: str = "") -> None:
        """`details` are for logs only, such as a library's message."""
        super().__init__(f"{file}: `{field}` {problem}{': ' if details else ''}{details}")
        self.file = file
        self.field = field
        self.problem = problem
        self.details = details

    def again(self) -> "SceneFileInvalid":
        """Return a copy without the traceback, which would keep the file's contents in memory."""
        return SceneFileInvalid(self.file, self.field, self.problem, self.details)


def _spelled_otherwise(name: str, known: list[str]) -> str:
    """A hint if a known name has the same letters, but its accents as characters of their own, as on some file systems,
    or the other way round."""
    normal = unicodedata.normalize("NFC", name)
    if any(unicodedata.normalize("NFC", each) == normal for each in known):
        return ". One looks the same: its file's name has accents in another Unicode form (NFC or NFD); rename the file"
    return ""
