"""Choose the fastest exported file of a model with a minimal measured PSNR (`min_psnr`)."""

from collections.abc import Iterator

from msdgs_serve.scene import InvalidInput, SceneFileInvalid, SceneNotFound
from msdgs_serve.scene.baked import SceneMetadata
from msdgs_serve.scene_report import read_report
from msdgs_serve.store import SceneStore, ServedScene

FIELD = "min_psnr"


def fastest_within(store: SceneStore, scene: ServedScene, decibels: float) -> ServedScene:
    """Return the fastest of `walk.onnx` and the files `walk.….onnx` of the same model beside it, whose worst frame has
    at least `decibels` (PSNR against the full model). Times are from the reports beside the files; without reports,
    return the smallest file.

    Raises `InvalidInput` if no file has that PSNR, or none has a measured one.
    """
    measured = [(each, error) for each in _of_one_model(store, scene) if (error := worst_decibels(each)) is not None]
    if not measured:
        raise InvalidInput(FIELD, f"left out, as no file of `{scene.name}` has a measured PSNR", decibels)
    fitting = [each for each, error in measured if error >= decibels]
    if not fitting:
        best = max(error for _, error in measured)
        raise InvalidInput(FIELD, f"at most {best:.1f} dB, the highest of the files of `{scene.name}`", decibels)
    milliseconds = _reported_milliseconds(store, [each for each, _ in measured])
    unknown = float("inf")
    return min(fitting, key=lambda each: (milliseconds.get(_key(each), unknown), each.signature.size))


def worst_decibels(scene: ServedScene) -> float | None:
    """Return the file's measured PSNR of the worst frame against the full model, or None."""
    rendered = scene.session.scene.metadata.measured_error.get("rendered")
    value = rendered.get("psnr_worst") if isinstance(rendered, dict) else None
    return float(value) if isinstance(value, int | float) else None


def _of_one_model(store: SceneStore, scene: ServedScene) -> Iterator[ServedScene]:
    yield scene
    for name in store.names():
        other = _beside(store, scene, name) if name.startswith(f"{scene.name}.") else None
        if other is not None and _metadata(other).checkpoint_sha256 == _metadata(scene).checkpoint_sha256:
            yield other


def _beside(store: SceneStore, scene: ServedScene, name: str) -> ServedScene | None:
    """Return the scene `name` if its file is in the folder of that of `scene`, valid, and not removed meanwhile."""
    try:
        return store.get(name) if store.file(name).parent == scene.signature.path.parent else None
    except (SceneFileInvalid, SceneNotFound):
        return None  # the store logs what is invalid


def _reported_milliseconds(store: SceneStore, scenes: list[ServedScene]) -> dict[tuple[str, float], float]:
    """Return milliseconds per frame by plan and PSNR, from the reports beside the files."""
    found: dict[tuple[str, float], float] = {}
    for scene in scenes:
        try:
            report = read_report(store.file(scene.name), _metadata(scene).checkpoint_sha256) or {}
            for point in report.get("points", []):
                key = (point["plan"], point["error"]["psnr_worst"])
                found.setdefault(key, float(point["milliseconds"]["total"]["min"]))
        except (SceneFileInvalid, LookupError, TypeError, ValueError, OverflowError):
            continue  # an invalid report counts as none
    return found


def _key(scene: ServedScene) -> tuple[str, float]:
    return _metadata(scene).plan, worst_decibels(scene) or 0.0


def _metadata(scene: ServedScene) -> SceneMetadata:
    return scene.session.scene.metadata
