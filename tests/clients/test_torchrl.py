"""TorchRL: its wrappers, its checker, and a policy that all agents of one kind share."""

import hive_torchrl
import numpy as np
import pytest
import torch
from examples.greenhouse_coop import env as greenhouse
from gymnasium import spaces
from hive import BEES, DEFINITION, MASKED, Bee, HiveSim, points
from torchrl.envs import ExplorationType, GymWrapper, PettingZooWrapper, check_env_specs, set_exploration_type

from simenv_marl import RULE, aec_env, parallel_env, simulate
from simenv_marl.envs import pad_agents

from .page import blocks

HELD_OUT = range(10_000, 10_020)
VIEWS = {"parallel": parallel_env, "aec": aec_env}
EVERY_VIEW = pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)


def test_the_checks_of_the_page_pass():
    exec(blocks("_clients_torchrl.md")[0], {})


@pytest.mark.parametrize("make", [greenhouse.parallel_env, greenhouse.raw_env, greenhouse.env])
@pytest.mark.parametrize("grouped", [None, {"agents": ["waterer_0", "ventilator_0"]}])
def test_the_greenhouse_passes_the_checks(make, grouped):
    env = PettingZooWrapper(make(), use_mask=True, group_map=grouped)
    check_env_specs(env)
    env.set_seed(1)
    days = env.rollout(300)
    assert days["next", "done"][-1].all()
    assert not days["next", "done"][:-1].any()


def test_single_views_pass_the_checks():
    check_env_specs(GymWrapper(greenhouse.watering_env()))


@EVERY_VIEW
@pytest.mark.parametrize("done_on_any", [True, False])
@pytest.mark.parametrize("grouped", [None, {"bees": BEES}], ids=["apart", "together"])
@pytest.mark.parametrize("definition", [DEFINITION, MASKED], ids=["free", "masked"])
def test_agents_that_are_born_and_die_pass_the_checks(view, definition, grouped, done_on_any):
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
def test_the_state_is_part_of_the_tensors(view):
    options = {"possible_agents": BEES, "state_space": spaces.Box(0, 1, (4,), np.float32)}
    env = PettingZooWrapper(pad_agents(view(HiveSim, points(), **options)), use_mask=True, return_state=True)
    check_env_specs(env)
    assert env.rollout(5)["state"].shape == (5, 4)


def worth(env, policy):
    """The nectar that all bees bring home over seeds that no training has seen."""
    brought = 0.0
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for seed in HELD_OUT:
            env.set_seed(seed)
            brought += env.rollout(1000, policy)["next", "bees", "reward"].sum().item()
    return brought / len(HELD_OUT)


@EVERY_VIEW
def test_one_policy_for_all_who_are_born(view):
    env = hive_torchrl.make(view)
    policy, loss = hive_torchrl.learner(env)
    before = worth(env, policy)
    hive_torchrl.train(env, policy, loss)
    after = worth(env, policy)
    assert after > before + 4
    learnt, rule = (
        np.mean([simulate(HiveSim, {Bee.choose_meadow: own}, points=points(), seed=seed).hive.day for seed in HELD_OUT])
        for own in (hive_torchrl.single(policy), RULE)
    )
    assert learnt >= rule
