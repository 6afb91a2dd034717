"""A package, so that no other `tests` on the path is imported: one folder for each part, helpers in support/."""
