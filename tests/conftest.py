"""Settings of the tests."""

import gc

from hypothesis import settings

from simenv_marl._plan import Options

# Hypothesis draws the same examples at every run, and keeps no files.
settings.register_profile("tests", deadline=None, derandomize=True, database=None)
settings.load_profile("tests")


def pytest_addoption(parser) -> None:
    parser.addoption("--driver", choices=["greenlet", "thread"], default="greenlet")


def pytest_configure(config) -> None:
    Options.__init__.__kwdefaults__["driver"] = config.getoption("--driver")


def pytest_collection_finish() -> None:
    """Spare the many calls of the collector what is imported anyway."""
    gc.collect()
    gc.freeze()
