"""Settings of the tests with real learners."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))  # the models of the pages

torch = pytest.importorskip("torch")


def pytest_configure(config):
    """Allow the learners' warnings; this library's, and lost exceptions, are errors."""
    for line in (
        "default",
        "error:::simenv_marl",
        "error::pytest.PytestUnraisableExceptionWarning",
        "error::pytest.PytestUnhandledThreadExceptionWarning",
    ):
        config.addinivalue_line("filterwarnings", line)


@pytest.fixture(autouse=True)
def _the_same_at_every_run():
    torch.set_num_threads(1)
    torch.manual_seed(0)
