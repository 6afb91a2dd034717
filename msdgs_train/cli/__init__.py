"""Command line of `msdgs-train`: one module per command, with its options and its terminal output."""
