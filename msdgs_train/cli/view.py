"""`msdgs-train view`."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from msdgs_train.cli.console import console

if TYPE_CHECKING:
    from msdgs_train.viewer.viewer import Viewer


@dataclass(frozen=True)
class View:
    """View a trained model in a browser: any view and time, after each layer of the deformation. Ctrl-C ends it.
    Needs: pip install 'msdgs[viewer]'

    Example:  msdgs-train view runs/first/model.pt
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The model.pt or best.pt of a run."""
    port: int = 8080
    """Port to listen on; the next free one if it is taken, any free one if 0."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all networks."""

    def execute(self) -> int:
        from msdgs_train.gaussians.model_file import load_model
        from msdgs_train.viewer.viewer import show_model

        loaded = load_model(self.model)
        with open_viewer(self.host, self.port) as viewer, contextlib.suppress(KeyboardInterrupt):
            show_model(viewer, loaded, str(self.model))
            viewer.wait_for_interrupt()
        return 0


def open_viewer(host: str, port: int) -> "Viewer":
    from msdgs_train.viewer.viewer import Viewer

    viewer = Viewer(host, port)
    console.print(f"viewer: {viewer.url}", soft_wrap=True)
    return viewer
