"""The library's check, with PettingZoo's and Gymnasium's, on the environments of all examples."""

import pickle
from functools import partial

import pytest
from examples.emergency.env import EmergencySimulation
from examples.fin_base.env import PREMIUMS, TEAM, FundSim
from examples.fin_base.pension import Parameters
from examples.greenhouse_coop.env import VENTILATION, WATERING, GreenhouseSim
from examples.market_seats.env import Free, Levied
from examples.queue_admission.env import QueueSimulation
from examples.wolf_sheep.env import Meadow, sheep_points
from gymnasium.utils.env_checker import check_env, data_equivalence

from simenv_marl import aec_env, joint_env
from simenv_marl.testing import check_simulation
from tests.worlds.models import play

MANAGER = {
    point: definition for point, definition in TEAM.items() if definition.agent == "manager_0"
}
# poor enough for plans, cuts and demands
fund = partial(FundSim, 3, Parameters(clients=60, coverage=1.0))
meadow = partial(Meadow, 25, width=8, height=8, initial_sheep=20, initial_wolves=5)

EXAMPLES = {
    "greenhouse": (GreenhouseSim, None),
    "watering": (GreenhouseSim, WATERING),
    "ventilation": (GreenhouseSim, VENTILATION),
    "team of the fund": (fund, TEAM),
    "manager of the fund": (fund, MANAGER),
    "clients of the fund": (fund, PREMIUMS),
    "market": (Free, None),
    "market with a levy": (Levied, None),
    "queue": (QueueSimulation, None),
    "emergency department": (EmergencySimulation, None),
    "sheep": (meadow, sheep_points(1)),
    "sheep that see further": (meadow, sheep_points(2)),
}


@pytest.mark.filterwarnings("ignore:.*maximum value is infinity")  # of their energy
def test_gymnasium_check_env_accepts_the_herd_example_in_joint_env():
    herd = [f"sheep_{number}" for number in range(1, 21)]
    check_env(joint_env(meadow, possible_agents=herd, undeclared="rule"), skip_render_check=True)


@pytest.mark.thorough
@pytest.mark.parametrize("name", EXAMPLES)
def test_check_simulation_finds_nothing_in_the_examples(name):
    simulation, points = EXAMPLES[name]
    env = aec_env(simulation, points)
    copied = pickle.loads(pickle.dumps(env))
    assert data_equivalence(play(copied, seed=1), play(env, seed=1))
    report = check_simulation(simulation, points, episodes=2)
    assert not [finding for finding in report.findings if finding.severity != "note"], report
