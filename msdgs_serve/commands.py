"""Entry points of the installed commands: the heavy modules are imported once the process is prepared."""

import signal

from msdgs_serve.process import begin


def render() -> int:
    """`msdgs-render`; returns the exit status."""
    begin()
    from msdgs_serve.render_cli import main

    return main()


def serve() -> int:
    """`msdgs-serve`; returns the exit status."""
    handler = signal.getsignal(signal.SIGINT)
    begin()
    from msdgs_serve.api.cli import main

    signal.signal(signal.SIGINT, handler)  # the server has its own
    return main()
