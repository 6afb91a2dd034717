"""What a test may lack: where that is meant to be so, and what brings the rest.

In CI (`CI` or `MSDGS_CI` is set) a run fails if it skips a test for a reason that isn't in `ALLOWED_SKIPS`. Others end
in a line that says what was not tested, and the command that would bring it.
"""

from typing import NamedTuple

ALLOWED_SKIPS = {
    "needs Ray": "350 MB that conflict with nothing and serve few: `make test-cluster`",
    "viser isn't installed": "it wants older versions of what all else is tested with: `make test-viewer`",
    "skipped: no Docker daemon": "a container has none; who builds the image runs docker/check.py",
    "skipped: there is no docker command": "a container has none, as above",
    "MSDGS_SPLATS names no folder": "files of other programs, which are not ours to pass on",
    "reaches into the process of the service": "on Ray Serve it is another process (MSDGS_TEST_SERVICE=ray)",
    "slow connections end at the proxy": "on Ray Serve (MSDGS_TEST_SERVICE=ray)",
}
"""Reasons, by how they begin, and why the test doesn't run everywhere."""


class Lack(NamedTuple):
    """What a reason begins with, what is not tested for it, and a package of Debian's or else of Python's."""

    reason: str
    untested: str
    debian: str = ""
    python: str = ""


LACKS = (
    Lack("no Chromium on this machine", "the page in a browser", debian="chromium libatomic1"),
    Lack("there is no prometheus to run", "the dashboard's queries", debian="prometheus"),
    Lack("needs strace", "which files native code opens", debian="strace"),
    Lack("kubernetes-validate isn't installed", "the Kubernetes manifests", python="kubernetes-validate"),
)


def unexpected(reasons: list[str]) -> list[str]:
    """Those of the reasons that tests were skipped for that `ALLOWED_SKIPS` doesn't name, each once."""
    return sorted({reason for reason in reasons if not reason.startswith(tuple(ALLOWED_SKIPS))})


def not_tested(reasons: list[str]) -> str:
    """One line of what these skips left out and the command that brings it; empty if nothing did."""
    counts = {lack: sum(reason.startswith(lack.reason) for reason in reasons) for lack in LACKS}
    lacking = [lack for lack, count in counts.items() if count]
    if not lacking:
        return ""
    debian = " ".join(lack.debian for lack in lacking if lack.debian)
    python = " ".join(lack.python for lack in lacking if lack.python)
    commands = [f"apt-get install {debian}"] * bool(debian) + [f"pip install {python}"] * bool(python)
    what = ", ".join(f"{lack.untested} ({counts[lack]})" for lack in lacking)
    return f"Not tested on this machine: {what}. To test it: {' && '.join(commands)}"
