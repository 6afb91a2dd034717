"""Training: `training_step`, `known_motion`, `k_steps`, and systems and scenes for `msdgs-train compare`."""
