"""Shared settings of the tests."""

import os

# the pool has two threads wherever the tests run, so that parallel code is tested as parallel code
os.environ.setdefault("MSDGS_THREADS", "2")
