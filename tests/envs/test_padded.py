"""Padded rosters: every possible agent is present, from the reset to the end of the episode."""

import copy
import pickle
import random

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, aec_env, parallel_env, single_env
from simenv_marl.envs import pad_agents
from simenv_marl.errors import UnknownAgentError, ViewError
from tests.worlds.entities import (
    HERE,
    ROSTER,
    AnnouncingColony,
    AnsweredColony,
    Colony,
    beings,
    colony_designs,
    colony_points,
    life,
    play_colony,
    seeds,
)
from tests.worlds.models import begun, decision, script

EVERYBODY = st.tuples(colony_designs, seeds, st.sampled_from([Colony, AnnouncingColony]))


def colony(design, kind, view, padded=False):
    points = colony_points(overseen=bool(design.overseen))
    env = view(lambda: kind(design), points, possible_agents={f"{HERE}.Creature.act": ROSTER})
    return pad_agents(env) if padded else env


def is_blank(env, agent, observation):
    return env.observation_space(agent).contains(observation) and not np.any(observation)


@given(EVERYBODY)
def test_pad_agents_of_aec_env_selects_live_agents_only(world):
    def look(agent):
        assert sorted(env.agents) == everybody
        assert env.infos[agent] == {"present": True}
        for other in everybody:
            assert not env.terminations[other]
            assert not env.truncations[other]
            assert set(env.infos[other]) == {"present"}
            assert env.infos[other]["present"] or is_blank(env, other, env.observe(other))

    design, seed, kind = world
    env = colony(design, kind, aec_env, padded=True)
    everybody = sorted(env.possible_agents)
    decided, totals, ends = play_colony(env, seed, look)
    assert sorted(env.possible_agents) == everybody
    assert env.agents == []
    plain = AnsweredColony(design, seed)
    assert decided == plain.decisions
    assert env.simulation.trace == plain.trace
    assert totals == dict.fromkeys(everybody, 0.0) | plain.totals
    assert ends == dict.fromkeys(everybody, (not design.truncates, design.truncates))


@given(EVERYBODY)
def test_pad_agents_of_parallel_env_adds_all_agents_to_its_results(world):
    design, seed, kind = world
    env, bare = (colony(design, kind, parallel_env, padded=padded) for padded in (True, False))
    observations, infos = env.reset(seed=seed)
    expected, _ = bare.reset(seed=seed)
    everybody = list(env.possible_agents)
    chance = random.Random(seed)
    while env.agents:
        assert env.agents == everybody
        env.agents.clear()  # a list for the caller
        present = {agent for agent in everybody if infos[agent]["present"]}
        for agent in everybody:
            if agent in present:
                assert observations[agent].tolist() == expected[agent].tolist()
            else:
                assert is_blank(env, agent, observations[agent])
                assert not infos[agent]["deciding"]
        actions = {
            agent: chance.choice([0, 1, 2, 3, 4, 99 if agent not in present else RULE])
            for agent in everybody
        }
        told = env.step(actions)
        observations, rewards, terminations, truncations, infos = told
        expected, paid, *_ = bare.step({agent: actions[agent] for agent in present})
        assert all(set(book) == set(everybody) for book in told)
        assert {agent: value for agent, value in rewards.items() if value} == {
            a: v for a, v in paid.items() if v
        }
        assert {tuple(sorted(info)) for info in infos.values()} == {
            ("acted", "deciding", "present")
        }
        flags = set(zip(terminations.values(), truncations.values(), strict=True))
        over = not bare.agents
        assert flags == {(over and not design.truncates, over and design.truncates)}
        assert all(type(flag) is bool for flag in (*terminations.values(), *truncations.values()))
    assert env.simulation.trace == bare.simulation.trace
    env.close()
    bare.close()


NAMES = ["being_1", "being_2"]
VIEWS = [(parallel_env, {"being_1": 3, "being_2": 4}), (aec_env, 3)]
GENERATIONS = life("1 acts, 1 health 7, 1 leaves, 2 health 1, 2 acts, 2 acts")


def test_pad_agents_gives_removed_agents_their_reward_then_blank_values():
    env = begun(pad_agents(parallel_env(GENERATIONS, beings(), possible_agents=NAMES)))
    observations, rewards, *_, infos = env.step({"being_1": 3, "being_2": 4})
    assert env.simulation.log == [3]  # the other one was not there yet when it was given
    assert rewards == {"being_1": 7.0, "being_2": 0.0}
    assert observations["being_1"].tolist() == [0, 0]
    assert infos["being_1"] == {"present": False, "deciding": False, "acted": True}
    assert infos["being_2"] == {"present": True, "deciding": True, "acted": False}
    _, rewards, _, _, infos = env.step({"being_1": "not looked at", "being_2": 4})
    assert rewards == {"being_1": 0.0, "being_2": 1.0}
    assert infos["being_1"]["acted"] is False
    with pytest.raises(UnknownAgentError, match="not a live agent"):
        env.step({"being_3": 1})


@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize(("view", "action"), VIEWS)
def test_pad_agents_truncates_all_agents_at_max_steps(steps, view, action):
    env = begun(pad_agents(view(GENERATIONS, beings(), possible_agents=NAMES, max_steps=steps)), 0)
    for _ in range(steps):
        results = env.step(action)
    terminations, truncations = results[2:4] if results else (env.terminations, env.truncations)
    assert truncations == {"being_1": True, "being_2": True}
    assert terminations == {"being_1": False, "being_2": False}


def test_pad_agents_gives_absent_agents_open_masks_and_the_current_time():
    program = "1 acts, 1 o'clock, 1 acts, 1 leaves, 2 o'clock, 2 acts, 3 o'clock, 2 acts"
    masked = beings(
        action_mask_mapping=lambda being: [0, 1, 0],
        action_space=spaces.Discrete(3),
        observation_space=spaces.Dict(health=spaces.Discrete(9), action_mask=spaces.MultiBinary(3)),
        observation_space_mapping=lambda being: {"health": being.health},
    )
    names = ["being_1", "being_2", "being_3"]
    env = pad_agents(parallel_env(life(program, timed=True), masked, possible_agents=names))
    observations, infos = env.reset(seed=0)
    hours = [0.0]
    while True:
        for agent in names:
            mask = [0, 1, 0] if infos[agent]["present"] else [1, 1, 1]
            assert (
                infos[agent]["action_mask"].tolist()
                == observations[agent]["action_mask"].tolist()
                == mask
            )
            assert set(infos[agent]) == {
                "present",
                "deciding",
                "acted",
                "action_mask",
                "time",
                "elapsed",
            }
            assert infos[agent]["time"] == hours[-1]
        if not env.agents:
            break
        observations, _, _, _, infos = env.step(dict.fromkeys(names, 1))
        hours.append(env.simulation.now)
    assert hours == [0.0, 1.0, 2.0, 3.0, 3.0]


def test_pad_agents_has_no_agents_after_an_error_until_the_reset():
    points = beings(reward_mapping=lambda being: 1 / (1 - being.health))
    env = begun(pad_agents(aec_env(GENERATIONS, points, possible_agents=NAMES)), 0)
    with pytest.raises(ZeroDivisionError):
        env.step(1)
    assert env.agents == []
    env.reset(seed=0)
    assert sorted(env.agents) == NAMES


def test_pad_agents_needs_a_multi_agent_env_with_possible_agents():
    for view in (aec_env, parallel_env):
        with pytest.raises(ViewError, match="possible_agents"):
            pad_agents(view(GENERATIONS, beings()))
    function = decision()
    with pytest.raises(ViewError, match="aec_env or parallel_env"):
        pad_agents(single_env(script(lambda simulation: function()), function))


@pytest.mark.parametrize(("view", "action"), VIEWS)
def test_pad_agents_state_has_blanks_and_its_copy_needs_a_reset(view, action):
    env = begun(
        pad_agents(view(GENERATIONS, beings(), possible_agents=NAMES, state_space="observations")),
        0,
    )
    assert env.state()[:2].tolist() == [1, 0]
    env.step(action)
    assert env.state()[:2].tolist() == [0, 0]
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert twin.agents == []
        twin.reset(seed=0)
        assert (twin.agents, twin.state()[:2].tolist()) == (NAMES, [1, 0])
