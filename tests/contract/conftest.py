"""The contract is tested with every driver."""

from tests.extent import DRIVERS


def pytest_generate_tests(metafunc):
    chosen = metafunc.config.getoption("--driver")
    alone = metafunc.definition.get_closest_marker("greenlet") is not None
    drivers = ["greenlet"] if alone else DRIVERS if chosen == "both" else [chosen]
    metafunc.parametrize("_driver", drivers, indirect=True)
