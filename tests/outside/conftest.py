"""What is outside Python is tested with every driver."""

import pytest

from tests.conftest import DRIVERS
from tests.outside.compiling import HERE, compiled


def pytest_generate_tests(metafunc) -> None:
    chosen = metafunc.config.getoption("--driver")
    alone = metafunc.definition.get_closest_marker("greenlet") is not None
    drivers = ["greenlet"] if alone else DRIVERS if chosen == "both" else [chosen]
    metafunc.parametrize("_driver", drivers, indirect=True)


@pytest.fixture
def make_env():
    """Makes environments, and closes them."""
    made = []

    def make(kind, *arguments, **options):
        made.append(kind(*arguments, **options))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Where programs in C++ are compiled."""
    return tmp_path_factory.mktemp("cpp")


@pytest.fixture(scope="session")
def probe(folder):
    """The program that plays what an option names."""
    return compiled(HERE / "probe.cpp", folder)
