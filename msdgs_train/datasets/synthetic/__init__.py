"""A synthetic moving scene with known motion, rendered by ray marching into D-NeRF layout."""
