"""Domain errors, raised low and mapped to an HTTP status in one table of `msdgs_serve.api.errors`.

MsdgsError
├── InvalidInput      a value that a caller gave is wrong; `field` names it
├── SceneNotFound     no scene of that name
└── SceneFileInvalid  a scene file breaks the contract; `field` names what
"""


class MsdgsError(Exception):
    """Base of every error that this project raises on purpose."""


class InvalidInput(MsdgsError, ValueError):
    """A value breaks its contract, as in "`camera.fov_y` must be in (0, 180) degrees, got 190"."""

    def __init__(self, field: str, expected: str, got: object) -> None:
        super().__init__(f"`{field}` must be {expected}, got {got}")
        self.field = field


class SceneNotFound(MsdgsError, KeyError):
    """No scene of this name is being served."""

    def __init__(self, name: str, known: list[str]) -> None:
        super().__init__(f"no scene `{name}`; there are: {', '.join(known) or 'none'}")
        self.name = name

    def __str__(self) -> str:
        return self.args[0]


class SceneFileInvalid(MsdgsError):
    """A scene file lacks something of contract `msdgs/1`, or says what can't be true."""

    def __init__(self, file: str, field: str, problem: str, details: str = "") -> None:
        """`details` are for logs alone, such as a library's own words."""
        super().__init__(f"{file}: `{field}` {problem}{': ' if details else ''}{details}")
        self.file = file
        self.field = field
        self.problem = problem
        self.details = details

    def again(self) -> "SceneFileInvalid":
        """The same without its traceback, which holds on to all that was being read."""
        return SceneFileInvalid(self.file, self.field, self.problem, self.details)
