"""Settings of Gaussians that others make ineffective, so that changing them is refused instead of ignored."""

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.engine.config import TrainConfig, differences


def refuse_unused(before: TrainConfig, changed: TrainConfig) -> None:
    """Raise `InvalidInput` naming a setting that differs from `before`, the preset or the run that is resumed, and has
    no effect."""
    reasons = _without_effect(changed)
    for name, _, value in differences(before, changed):
        if name in reasons:
            raise InvalidInput(f"config.{name}", f"left as it is, as it has no effect: {reasons[name]}", value)


def _without_effect(config: TrainConfig) -> dict[str, str]:
    """Why settings have no effect, by name."""
    found = dict[str, str]()
    if not config.model.layers:
        names = ("weights", "time_noise", "static_fraction", "static_window_fraction", "window_start_width")
        found |= dict.fromkeys(names, "there are no layers")
    if not config.curriculum.window_full_fraction:
        names = ("window_start_width", "static_window_fraction", "eps2d_init")
        found |= dict.fromkeys(names, "window_full_fraction is 0, so that no time window grows")
    if not (config.model.layers and config.model.embedding_dim):
        names = ("modulation_targets", "modulation_lr_init", "modulation_lr_final")
        found |= dict.fromkeys(names, "embedding_dim is 0" if config.model.layers else "there are no layers")
    return found
