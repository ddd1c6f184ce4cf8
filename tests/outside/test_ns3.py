"""ns-3, left to itself and through environments: a simulator whose loop, time and events are its own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import warnings
from contextlib import ExitStack, closing
from functools import partial
from itertools import zip_longest
from typing import Any

import numpy as np
import pytest
from examples.ns3_senders.env import POINTS, missing, parallel_env, program, raw_env, senders
from examples.ns3_senders.train import POINT, Linear, compare, learn
from pettingzoo import test as kit

from simenv_marl import RULE, branch, simulate, simulate_many
from simenv_marl.errors import ProcessDiedError
from tests.outside.compiling import ROOT

pytestmark = [
    pytest.mark.skipif(bool(missing()), reason=f"the senders need {missing()}"),
    pytest.mark.filterwarnings("ignore::UserWarning"),  # what PettingZoo says of environments without a roster
]

BRIEF = {"seconds": 5.0}

WATCHFUL = Linear((-0.35, -1.65, 0.62, 0.61, 0.06))
"""Keeps its queue short."""


def plain(seed: int, **options: Any) -> Any:
    """What the model tells by itself."""
    command = [program(), str(seed), json.dumps(options)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)


def turns(env: Any) -> Any:
    """Play to the end by the rule, one step at a time."""
    for _ in env.agent_iter():
        _, _, terminated, truncated, _ = env.last()
        yield env.step(None if terminated or truncated else RULE)


def by_rule(env: Any, seed: int, **options: Any) -> Any:
    """What the model tells where all is left to its rule."""
    env.reset(seed=seed, options=options)
    for _ in turns(env):
        pass
    return env.simulation.result


def number(env: Any) -> int:
    """That of the process in which its simulator runs."""
    found: int = env.simulation._child.pid
    return found


@pytest.fixture
def env():
    with closing(raw_env()) as env:
        yield env


def test_by_its_rule_each_episode_is_the_plain_programs(env):
    for seed, options in [(7, {}), (8, {"hosts": 3}), (7, BRIEF), (2**40, BRIEF), (7, {})]:
        assert by_rule(env, seed, **options) == plain(seed, **options)


def test_the_code_of_its_page(capsys):
    page = (ROOT / "docs" / "ns3.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(code, {"__name__": "page"})
    assert capsys.readouterr().out == f"{plain(7, seconds=10)}\n"


def test_after_an_episode_that_was_given_up_too(env):
    for steps in (0, 1, 40):
        env.reset(seed=3)
        for _ in range(steps):
            agent = env.agent_selection
            env.step(None if env.terminations[agent] else env.action_space(agent).sample())
        process = number(env)
        assert by_rule(env, 7, **BRIEF) == plain(7, **BRIEF)
        assert number(env) == process, "the model unwinds, and its process plays on"


def test_in_rounds():
    with closing(parallel_env()) as env:
        env.reset(seed=7, options=BRIEF)
        while env.agents:
            env.step(dict.fromkeys(env.agents, RULE))
        assert env.simulation.result == plain(7, **BRIEF)


def test_by_itself():
    assert simulate(senders, seed=7).result == plain(7)


def test_interleaved_as_one_by_one():
    seeds = range(12)
    with ExitStack() as stack:
        envs = [stack.enter_context(closing(raw_env())) for _ in seeds]
        for seed, env in zip(seeds, envs, strict=True):
            env.reset(seed=seed, options=BRIEF)
        for _ in zip_longest(*map(turns, envs)):
            pass
        assert [env.simulation.result for env in envs] == [plain(seed, **BRIEF) for seed in seeds]


def test_one_that_is_killed_and_those_that_go_on():
    with closing(raw_env()) as one, closing(raw_env()) as other:
        for env in (one, other):
            env.reset(seed=7, options=BRIEF)
        one.step(RULE)
        os.kill(number(one), signal.SIGKILL)
        with pytest.raises(ProcessDiedError, match="SIGKILL"):
            for _ in turns(one):
                pass
        for _ in turns(other):
            pass
        assert other.simulation.result == plain(7, **BRIEF)
        assert by_rule(one, 7, **BRIEF) == plain(7, **BRIEF), "and the next episode is one like any other"


def test_who_leaves_terminates_and_who_is_there_in_the_end_is_truncated(env):
    env.reset(seed=7)
    ends: dict[str, str] = {}
    for agent in env.agent_iter():
        _, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            ends[agent] = "left" if terminated else "there"
        env.step(None if terminated or truncated else RULE)
    assert set(ends.values()) == {"left", "there"}
    assert len(ends) <= plain(7)["senders"], "some leave before they have decided"


def test_what_pettingzoo_asks_of_environments():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        kit.api_test(raw_env(), num_cycles=300)
        kit.seed_test(raw_env, num_cycles=50)
        kit.parallel_api_test(parallel_env(), num_cycles=100)
        kit.parallel_seed_test(parallel_env, num_cycles=50)


def test_observations_and_rewards_are_numbers_in_their_spaces(env):
    env.reset(seed=9)
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, info = env.last()
        assert env.observation_space(agent).contains(observation)
        assert np.isfinite(observation).all()
        assert np.isfinite(reward)
        assert 0 <= info["time"] <= 30
        env.step(None if terminated or truncated else env.action_space(agent).sample())


def test_the_chance_that_lies_ahead_is_drawn_anew_in_branches(env):
    env.reset(seed=7, options=BRIEF)
    for _ in range(5):
        env.step(RULE)

    def rest(continued: Any, _: int) -> Any:
        for _ in turns(continued):
            pass
        return continued.simulation.result

    first, second, again = branch(env, rest, 3, seeds=[1, 2, 1])
    assert first == again != second
    assert branch(env, rest)[0] == plain(7, **BRIEF)


def test_many_at_once_as_one_by_one():
    seeds = range(6)
    alone = compare({"watchful": {POINT: WATCHFUL}}, seeds, workers=0)
    rows = partial(map, WATCHFUL)
    many = simulate_many(senders, {POINT: lambda observations: np.stack(list(rows(observations)))}, seeds=seeds)
    assert [one.result["megabits"] for one in many] == alone.values("megabits")["watchful"].tolist()


def test_who_watches_its_queue_does_better_than_the_rule():
    found = compare({"rule": {}, "watchful": {POINT: WATCHFUL}}, range(12), workers=0, baseline="rule")
    assert found.summary().loc["watchful", "difference_low"] > 0
    assert found.summary("queueing").loc["watchful", "difference_high"] < 0


def test_it_learns():
    policy = learn(1, workers=0, episodes=1)
    assert len(policy.weights) == 1 + POINTS[POINT].observation_space.shape[0]
