"""Marks for tests of what holds in every view, and with every driver."""

import pytest

from simenv_marl import aec_env, joint_env, parallel_env, single_env
from tests.conftest import DRIVERS

VIEWS = (aec_env, parallel_env, joint_env, single_env)
EVERY_VIEW = pytest.mark.parametrize("view", VIEWS)

EVERY_DRIVER = pytest.mark.parametrize("_driver", DRIVERS, indirect=True)
"""Environments are made with that driver, unless they are told otherwise."""
