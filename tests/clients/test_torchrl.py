"""TorchRL: its wrappers, its checker, and a policy that all agents of one kind share."""

import hive_torchrl
import numpy as np
import pytest
from examples.greenhouse_coop import env as greenhouse
from gymnasium import spaces
from hive import BEES, DAYS, DEFINITION, MASKED, Bee, HiveSim, points
from torchrl.envs import GymWrapper, PettingZooWrapper, check_env_specs

from simenv_marl import aec_env, parallel_env, simulate
from simenv_marl.envs import pad_agents

from .page import blocks
from .returns import mean_return

VIEWS = {"parallel": parallel_env, "aec": aec_env}
EVERY_VIEW = pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)


def test_code_of_the_torchrl_page_passes_torchrls_checks():
    exec(blocks("_clients_torchrl.md")[0], {})


def test_torchrl_checks_accept_box_actions():
    for make in (greenhouse.parallel_env, greenhouse.raw_env, greenhouse.env):
        check_env_specs(PettingZooWrapper(make(), use_mask=True))
    check_env_specs(GymWrapper(greenhouse.watering_env()))


@EVERY_VIEW
@pytest.mark.parametrize("done_on_any", [True, False])
@pytest.mark.parametrize("grouped", [None, {"bees": BEES}], ids=["apart", "together"])
@pytest.mark.parametrize("definition", [DEFINITION, MASKED], ids=["free", "masked"])
def test_torchrl_checks_accept_agents_that_are_born_and_die(view, definition, grouped, done_on_any):
    env = PettingZooWrapper(
        pad_agents(view(HiveSim, points(definition), possible_agents=BEES)),
        use_mask=True,
        group_map=grouped,
        done_on_any=done_on_any,
    )
    check_env_specs(env)
    ends = set()
    for seed in range(60):
        env.set_seed(seed)
        ended = env.rollout(200)["next"]
        assert ended["done"][-1].all()
        assert not ended["done"][:-1].any()
        ends.add(bool(ended["truncated"][-1]))
        if len(ends) == 2:
            break
    assert ends == {True, False}


@EVERY_VIEW
def test_torchrl_tensors_contain_the_env_state(view):
    options = {"possible_agents": BEES, "state_space": spaces.Box(0, 1, (4,), np.float32)}
    env = PettingZooWrapper(
        pad_agents(view(HiveSim, points(), **options)), use_mask=True, return_state=True
    )
    check_env_specs(env)
    assert env.rollout(5)["state"].shape == (5, 4)


def worth(policy):
    """The nectar that all bees bring home."""
    decide = hive_torchrl.single(policy)
    return mean_return(
        HiveSim, points(), lambda bee, seen, info: decide(seen, info), possible_agents=BEES
    )


@EVERY_VIEW
def test_policy_shared_by_agents_that_are_born_and_die_learns(view):
    env = hive_torchrl.make(view)
    policy, loss = hive_torchrl.learner(env)
    before = worth(policy)
    hive_torchrl.train(env, policy, loss)
    assert worth(policy) > before + 4
    learnt = simulate(
        HiveSim, {Bee.choose_meadow: hive_torchrl.single(policy)}, points=points(), seed=1
    )
    assert learnt.hive.day == DAYS
