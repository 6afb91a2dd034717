"""Where a proxy serves the application under a prefix, a path begins with it."""

from starlette.types import Scope


def route_path(scope: Scope) -> str:
    """The path of a request as routes know it, without the prefix (ASGI's `root_path`)."""
    path, prefix = scope["path"], scope.get("root_path", "")
    return path.removeprefix(prefix) if path.startswith(f"{prefix}/") else path
