"""Reasons for which tests may be skipped, and commands that install what they need.

In CI (`CI` or `MSDGS_CI` is set) a run fails if it skips a test for a reason that isn't in `ALLOWED_SKIPS`. Other runs
end with a line that lists the untested parts and the command that installs what they need.
"""

from typing import NamedTuple

ALLOWED_SKIPS = {
    "needs Ray": "350 MB: `make test-cluster`",
    "viser isn't installed": "needs older versions of other packages: `make test-viewer`",
    "skipped: no Docker daemon": "containers have none; docker/check.py is run for releases",
    "skipped: there is no docker command": "containers have none, as above",
    "torch finds no GPU": "CI has none; tests/train/engine/test_cuda.py runs where there is one, with gsplat and nvcc",
    "MSDGS_SPLATS names no folder": "files of other programs, which can't be redistributed",
    "reaches into the process of the service": "on Ray Serve it is another process (MSDGS_TEST_SERVICE=ray)",
    "slow connections end at the proxy": "on Ray Serve (MSDGS_TEST_SERVICE=ray)",
}
"""Beginnings of reasons, and why the test doesn't run everywhere."""


class Lack(NamedTuple):
    """The beginning of a reason, the untested part, and the Debian or Python package or make target that it needs."""

    reason: str
    untested: str
    debian: str = ""
    python: str = ""
    make: str = ""


LACKS = (
    Lack("no Chromium on this machine", "the page in a browser", debian="chromium libatomic1"),
    Lack("there is no nginx to run", "the service behind a proxy", debian="nginx-light"),
    Lack("there is no prometheus to run", "the dashboard's queries", debian="prometheus"),
    Lack("needs strace", "which files native code opens", debian="strace"),
    Lack("kubernetes-validate isn't installed", "the Kubernetes manifests", python="kubernetes-validate"),
    Lack("no Firefox with a display", "a scene in Firefox", debian="firefox-esr xvfb libegl1 libgl1-mesa-dri"),
    Lack(
        "no tests/export/runtime/node_modules",
        "scenes that a browser draws",
        make="tests/export/runtime/node_modules",
    ),
    Lack("no tests/export/node/node_modules", "written files in other programs", make="tests/export/node/node_modules"),
)


def unexpected(reasons: list[str]) -> list[str]:
    """The reasons of skipped tests that `ALLOWED_SKIPS` doesn't have, each once."""
    return sorted({reason for reason in reasons if not reason.startswith(tuple(ALLOWED_SKIPS))})


def not_tested(reasons: list[str]) -> str:
    """One line with the untested parts and the command that installs what they need; empty if there are none."""
    counts = {lack: sum(reason.startswith(lack.reason) for reason in reasons) for lack in LACKS}
    lacking = [lack for lack, count in counts.items() if count]
    if not lacking:
        return ""
    needed = {
        "apt-get install": [lack.debian for lack in lacking if lack.debian],
        "pip install": [lack.python for lack in lacking if lack.python],
        "make": [lack.make for lack in lacking if lack.make],
    }
    commands = [" ".join((command, *names)) for command, names in needed.items() if names]
    what = ", ".join(f"{lack.untested} ({counts[lack]})" for lack in lacking)
    return f"Not tested on this machine: {what}. To test it: {' && '.join(commands)}"
