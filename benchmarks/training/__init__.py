"""Training: `training_step`, `known_motion`, `k_steps`, and systems for `msdgs-train compare`."""
