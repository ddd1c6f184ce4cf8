"""Settings of the tests."""

import gc

from hypothesis import settings

# Hypothesis draws the same examples at every run, and keeps no files.
settings.register_profile("tests", deadline=None, derandomize=True, database=None)
settings.load_profile("tests")


def pytest_collection_finish() -> None:
    """Spare the many calls of the collector what is imported anyway."""
    gc.collect()
    gc.freeze()
