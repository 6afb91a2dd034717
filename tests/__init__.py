"""A package, so that no other `tests` on the path is taken for it: one folder for each part, helpers in support/."""
