"""Refinement of the poses of training cameras, beside the model, which doesn't contain it."""
