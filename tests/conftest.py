"""Settings of the tests, and the drivers with which they run."""

import gc
import os
import random
import signal

import pytest
from hypothesis import HealthCheck, is_hypothesis_test, settings

from simenv_marl.core.plans.options import Options
from simenv_marl.core.switching import opened
from tests import extent

# A shell that starts the tests in the background has them ignore interrupts, which some are about.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    parser.addoption(
        "--driver",
        choices=(*extent.DRIVERS, "both"),
        default="both",
        help="drivers to test the contract with",
    )
    parser.addoption(
        "--extent",
        choices=("quick", "thorough", "all"),
        default="all",
        help="quick: few random examples, no tests that are marked thorough; thorough: the rest",
    )
    parser.addoption(
        "--order",
        metavar="SEED",
        help="shuffle files and tests by this seed, or by a new one: random",
    )


def pytest_configure(config):
    config.addinivalue_line(
        "markers", "greenlet(reason): what is tested is different with other drivers"
    )
    config.addinivalue_line("markers", "thorough: takes long, so `make test` leaves it out")
    if config.option.extent == "quick":
        extent.share = extent.QUICK
    # Hypothesis draws the same examples at every run, keeps no files, and ignores the clock.
    settings.register_profile(
        "tests",
        extent.examples(100),
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("tests")
    if config.option.order == "random":
        # The processes of pytest-xdist are to have the same one.
        config.option.order = os.environ.setdefault(
            "TEST_ORDER", str(random.SystemRandom().randrange(10**6))
        )


def pytest_report_header(config):
    return (
        f"files and tests in the order of --order {config.option.order}"
        if config.option.order
        else None
    )


def is_in_extent(item, chosen):
    """Whether a run of that extent has a test; both extents have the tests with random examples."""
    is_thorough = item.get_closest_marker("thorough") is not None
    if chosen == "quick":
        return not is_thorough
    return is_thorough or is_hypothesis_test(getattr(item, "obj", None))


def pytest_collection_modifyitems(config, items):
    if config.option.extent != "all":
        parts = {True: [], False: []}
        for item in items:
            parts[is_in_extent(item, config.option.extent)].append(item)
        config.hook.pytest_deselected(items=parts[False])
        items[:] = parts[True]
    if config.option.order:
        random.Random(config.option.order).shuffle(items)
        places = {
            path: place for place, path in enumerate(dict.fromkeys(item.path for item in items))
        }
        items.sort(key=lambda item: places[item.path])


@pytest.fixture(autouse=True)
def _driver(request, monkeypatch):
    """Makes environments with that driver, unless they are told otherwise."""
    monkeypatch.setitem(
        Options.__init__.__kwdefaults__, "driver", getattr(request, "param", "greenlet")
    )


def pytest_collection_finish():
    """Spare the many calls of the collector what is imported anyway."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Spare the collector's calls what the files before have left: it is the same from now on.

    Not in a fixture: until this hook returns, the test holds its fixtures, and what is frozen is
    never collected.
    """
    result = yield
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
        gc.freeze()
        # Forks find event loops among what is not frozen, and refuse epoll objects without a loop.
        opened._EPOLLS_BEFORE.update(opened.new_epolls())
    return result


@pytest.fixture
def _collected():
    """Disable finalizers during a test: at the end of the stack, one would swallow an error."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()
