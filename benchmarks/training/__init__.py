"""Training: `training_step`, `gpu_step`, `known_motion`, `k_steps`, `realistic`, `static_oracle`, and systems and
scenes for `msdgs-train compare`."""
