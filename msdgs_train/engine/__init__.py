"""Training loop: settings, schedule, curriculum, optimizer, checkpoints, and the run in its folder."""
