"""Shared settings of the tests."""

import os

# the pool has two threads wherever the tests run, so that parallel code is tested as parallel code
os.environ.setdefault("MSDGS_THREADS", "2")

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def tiny_numbers_stay():
    """A test that makes its process flush denormals would change every test that comes after it on its worker."""
    yield
    assert np.float32(1e-38) * np.float32(1e-2) > 0
