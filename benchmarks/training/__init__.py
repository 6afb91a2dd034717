"""Training: `training_step`, `known_motion`, and systems for `msdgs-train compare`."""
