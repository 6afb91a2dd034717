"""What `to_onnx.py` does with anything but a model.pt, and what it prints while it does."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from export.importers.detect import KINDS_OF_RUNS, READERS, checked_kind, frame_files, read_splats, recognise
from export.importers.runs.model import write_model
from export.importers.scene import digest, note_left_out, static_scene, write_imported
from export.importers.sequence import posed, read_sequence, sequence_scene, shown_rows
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.errors import InvalidInput


@contextmanager
def model_or_import(path: Path, kind: str | None, output: Path, console: Console) -> Iterator[Path | None]:
    """The model.pt to export: `path` itself, or one made of another trainer's run, there until the end of the block.

    Splats and sequences are written as scene files at once; then there is None. `kind` is one of `KINDS`, or None to
    look into the files. Raises `ImportFailed`, `InvalidInput` and `SceneFileInvalid`.
    """
    if kind is None:
        kind = "model" if not path.exists() or path.suffix == ".pt" else recognise(path)
    kind = checked_kind(kind)
    if kind == "model":
        yield path / "model.pt" if path.is_dir() else path
    elif kind in KINDS_OF_RUNS:
        with tempfile.TemporaryDirectory(prefix="msdgs-import-") as folder:
            model = Path(folder) / "model.pt"
            lost = write_model(path, kind, model, console)
            yield model
            if lost:
                note_left_out(output, lost)
    else:
        if not output.parent.is_dir():
            raise InvalidInput("output", "in a folder that exists", str(output))
        scene = _sequence(path, kind, output, console) if kind not in READERS else _splats(path, kind, output, console)
        _print(scene, output, console)
        yield None


def _splats(path: Path, kind: str, output: Path, console: Console) -> BakedScene:
    with console.status(f"reading {path}"):
        source = read_splats(path, kind)
        return write_imported(output, static_scene(source, digest(path)), lambda t: source.gaussians, [0.0])


def _sequence(path: Path, kind: str, output: Path, console: Console) -> BakedScene:
    how = kind.partition(":")[2] or None
    with Progress(console=console, transient=True) as progress:
        reading = progress.add_task("reading frames", total=len(frame_files(path)))
        sequence = read_sequence(path, how, lambda: progress.advance(reading))
        times = sequence.times()
        comparing = progress.add_task("comparing frames", total=len(times))
        scene = write_imported(
            output,
            sequence_scene(sequence, digest(path)),
            lambda t: posed(sequence, times.index(t)),
            times,
            lambda: progress.advance(comparing),
            rows=lambda t: shown_rows(sequence, times.index(t)),
        )
    way = "blended into each other" if sequence.blended else "switched, since they don't correspond or were not to"
    console.print(f"{len(times)} frames, {way}")
    return scene


def _print(scene: BakedScene, output: Path, console: Console) -> None:
    for entry in scene.metadata.left_out:
        console.print(f"left out: {entry['what']}: {entry['count']:,} of {entry['of']:,}", markup=False)
    console.print(
        f"{output}: plan {scene.metadata.plan}, {output.stat().st_size / 1e6:.2f} MB, {scene.moving_count:,} moving "
        f"and {scene.static_count:,} static Gaussians, SH of degree {scene.metadata.sh_degree}",
        markup=False,
    )
