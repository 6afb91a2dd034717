"""Browser viewer of a model, trained or in training."""
