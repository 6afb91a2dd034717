"""From videos to a dataset with camera poses and times: a COLMAP folder and `times.json`."""
