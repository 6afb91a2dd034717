"""Volume renderers: density and color at points of space and time, marched along rays."""
