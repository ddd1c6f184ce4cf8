"""Settings of the tests, and the drivers with which they run."""

import gc
import signal

import pytest
from hypothesis import settings

from simenv_marl.core.options import Options

# Hypothesis draws the same examples at every run, and keeps no files.
settings.register_profile("tests", deadline=None, derandomize=True, database=None)
settings.load_profile("tests")

# A shell that starts the tests in the background has them ignore interrupts, which some are about.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

DRIVERS = ("greenlet", "thread")

CONTRACT = (
    "collected", "conformance", "ends", "environments", "episodes", "errors", "faults", "goals_and_time", "identity",
    "joint", "many_agents", "mesa", "properties", "rounds", "side_by_side", "simulate", "simulate_many", "simulations",
    "unwinding",
)  # fmt: skip
"""Modules of tests that say what happens when, whatever the driver. All others have nothing to do with one."""


def pytest_addoption(parser) -> None:
    parser.addoption("--driver", choices=(*DRIVERS, "both"), default="both", help="drivers to test the contract with")


def pytest_configure(config) -> None:
    config.addinivalue_line("markers", "greenlet(reason): what is tested is different with other drivers")


def pytest_generate_tests(metafunc) -> None:
    chosen = metafunc.config.getoption("--driver")
    if metafunc.module.__name__.rpartition("test_")[2] in CONTRACT:
        alone = metafunc.definition.get_closest_marker("greenlet") is not None
        drivers = ["greenlet"] if alone else DRIVERS if chosen == "both" else [chosen]
        metafunc.parametrize("_driver", drivers, indirect=True)


@pytest.fixture(autouse=True)
def _driver(request, monkeypatch):
    """Makes environments with that driver, unless they are told otherwise."""
    monkeypatch.setitem(Options.__init__.__kwdefaults__, "driver", getattr(request, "param", "greenlet"))


def pytest_collection_finish() -> None:
    """Spare the many calls of the collector what is imported anyway."""
    gc.collect()
    gc.freeze()
