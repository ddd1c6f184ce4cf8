"""A market town in Java and a network in ns-3: in environments they are what they are by themselves."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from contextlib import closing
from functools import cache
from typing import Any, NamedTuple

import pytest
from examples.jvm_market import build as building
from examples.jvm_market import env as town
from examples.ns3_senders import env as network
from examples.ns3_senders.train import POINT, Linear, compare

from simenv_marl.remote.check import check_wire
from tests.outside.compiling import ROOT
from tests.outside.reservoirs import child
from tests.outside.wire import exactly
from tests.worlds.models import follow_the_rule, play

EMPTY = 2
"""The seed of a town in which there is no shop any more after some weeks."""

BRIEF = {"seconds": 5.0}
WATCHFUL = Linear((-0.35, -1.65, 0.62, 0.61, 0.06))
"""Keeps its queue short."""


@cache
def plain_town(seed: int) -> Any:
    """What the town tells by itself."""
    return town.plain(seed)["result"]


def plain_network(seed: int, **options: Any) -> Any:
    """What the network tells by itself."""
    command = [network.program(), str(seed), json.dumps(options)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)


def no_java() -> str:
    """Why the town cannot be built."""
    try:
        building.java()
    except RuntimeError as error:
        return str(error)
    return ""


class Model(NamedTuple):
    """One of the two."""

    missing: Callable[[], str]
    raw_env: Callable[..., Any]
    plain: Callable[..., Any]
    episodes: list[tuple[int, dict[str, Any]]]


TOWN = Model(no_java, town.raw_env, plain_town, [(seed, {}) for seed in (3, 4, 5, EMPTY)])
NETWORK = Model(
    network.missing,
    network.raw_env,
    plain_network,
    [(7, {}), (8, {"hosts": 3}), (7, BRIEF), (2**40, BRIEF), (7, {})],
)

of_the_town = pytest.mark.parametrize("model", [TOWN], ids=["town"], indirect=True)
of_the_network = pytest.mark.parametrize("model", [NETWORK], ids=["network"], indirect=True)

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # what PettingZoo says where no roster is declared


@pytest.fixture(params=[TOWN, NETWORK], ids=["town", "network"])
def model(request):
    if missing := request.param.missing():
        pytest.skip(missing)
    return request.param


@pytest.fixture
def env(model):
    with closing(model.raw_env()) as env:
        yield env


def test_by_its_rule_each_episode_is_the_plain_model(model, env):
    for seed, options in model.episodes:  # in one process
        env.reset(seed=seed, options=options)
        play(env, reset=False)
        assert exactly(env.simulation.result) == exactly(model.plain(seed, **options))


def test_an_episode_that_is_given_up_leaves_nothing_to_the_next(model, env):
    for steps in (0, 1, 40):
        env.reset(seed=3)
        for _ in range(steps):
            agent = env.agent_selection
            env.step(None if env.terminations[agent] else env.action_space(agent).sample())
        number = child(env)
        assert exactly(follow_the_rule(env, 4).result) == exactly(model.plain(4))
        assert child(env) == number, "the model unwinds, and its process plays on"


@of_the_town
def test_towns_differ_and_one_of_them_is_empty_in_the_end(model):
    found = [plain_town(seed) for seed in (3, 4, 5)]
    assert min(result["closed"] for result in found) > 10
    assert len({result["trace"][-1][2] for result in found}) == 3
    assert [town.plain(seed)["truncated"] for seed in (3, EMPTY)] == [True, False]
    assert town.plain(3, weeks=5)["result"]["weeks"] == 5
    report = check_wire(town.command(weeks=20))
    assert report.ok, str(report)
    assert len(report.findings) > 10


@of_the_town
def test_lives_begin_and_end_in_mid_episode(model, env):
    ends = {turn.agent: (turn.terminated, turn.truncated) for turn in play(env, seed=3)}
    result = env.simulation.result
    assert {f"farm_{number}" for number in range(1, 9)} | {f"shop_{number}" for number in range(9, 15)} < set(ends)
    assert len(ends) == result["founded"]
    assert sum(terminated for terminated, _ in ends.values()) == result["closed"] < len(ends)
    assert all(terminated != truncated for terminated, truncated in ends.values())
    assert not any(turn.truncated for turn in play(env, seed=EMPTY))


@of_the_network
def test_the_code_of_its_page(model, capsys):
    page = (ROOT / "docs" / "ns3.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(code, {"__name__": "page"})
    assert capsys.readouterr().out == f"{plain_network(7, seconds=10)}\n"


@of_the_network
def test_who_watches_its_queue_does_better_than_the_rule(model):
    found = compare({"rule": {}, "watchful": {POINT: WATCHFUL}}, range(12), workers=0, baseline="rule")
    assert found.summary().loc["watchful", "difference_low"] > 0
    assert found.summary("queueing").loc["watchful", "difference_high"] < 0
