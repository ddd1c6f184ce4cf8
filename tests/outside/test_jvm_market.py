"""The example in Java: a market town that is the same in an environment and without, and many of them side by side."""

import os
import signal
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from examples.jvm_market import build as building
from examples.jvm_market import env as example
from examples.jvm_market.compare import CONTENDERS, METRICS, by_the_granary, compare
from examples.jvm_market.env import PRICE, PRICES, SOW, env, market, parallel_env, raw_env
from pettingzoo import test as kit

from simenv_marl import RULE, branch, simulate, simulate_many
from simenv_marl.errors import InvalidActionError, ProcessDiedError, RemoteError
from simenv_marl.remote.check import check_wire
from tests.worlds.models import play

SEEDS = [3, 4, 5]
EMPTY = 2
"""The seed of a town in which there is no shop any more after some weeks."""

FARMS = [f"farm_{number}" for number in range(1, 9)]
SHOPS = [f"shop_{number}" for number in range(9, 15)]

plain = cache(example.plain)


@pytest.fixture(scope="module", autouse=True)
def _built():
    try:
        building.java()
    except RuntimeError as error:
        pytest.skip(str(error))
    building.build()


def jvms():
    """The processes that this one has started and that still run."""
    found = set()
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = status.read_text().rpartition(")")
        except OSError:  # it has ended meanwhile
            continue
        state, parent = rest.split()[:2]
        if int(parent) == os.getpid() and state != "Z" and name.endswith("(java"):
            found.add(int(status.parent.name))
    return found


def exactly(value):
    """A value that is equal only to one of the same types and bits."""
    return repr(value)


# -- the model stays what it is -------------------------------------------------------------------


def test_left_to_the_rule_it_is_the_plain_model():
    environment = raw_env()
    for seed in [*SEEDS, EMPTY]:  # in one process
        expected = plain(seed)
        turns = play(environment, seed=seed)
        assert exactly(environment.simulation.result) == exactly(expected["result"])
        over = {turn.agent: turn.truncated for turn in turns if turn.terminated or turn.truncated}
        assert over  # where the last of them all are those that lived to see the end
        assert any(over.values()) == expected["truncated"]
    environment.close()


def test_an_episode_that_is_left_leaves_nothing_to_the_next():
    environment = raw_env()
    before = jvms()
    environment.reset(seed=3)
    running = jvms()
    for steps in (1, 7, 300):
        for _ in range(steps):
            *_, terminated, truncated, _ = environment.last()
            environment.step(None if terminated or truncated else RULE)
        environment.reset(seed=4)
    assert jvms() == running > before  # it is the same process all the time
    assert exactly(finished(environment)) == exactly(plain(4)["result"])
    environment.close()
    assert jvms() == before


def test_a_decision_of_another_type_is_an_error_with_its_trace():
    points = example.points()
    points[SOW] = replace(points[SOW], action_space_mapping=float)
    environment = raw_env(points=points)
    environment.reset(seed=3)
    with pytest.raises(RemoteError, match=r"(?s)farm\.sow cannot take the decision 3\.0.*at market\.Market"):
        environment.step(3)
    environment.reset(seed=4)
    assert exactly(environment.simulation.result) == "None"
    environment.close()


def test_in_rounds_as_well():
    environment = parallel_env()
    environment.reset(seed=3)
    while environment.agents:
        environment.step(dict.fromkeys(environment.agents, RULE))
    assert exactly(environment.simulation.result) == exactly(plain(3)["result"])
    environment.close()


@pytest.mark.greenlet("no environment takes part")
def test_runs_are_lively():
    found = [plain(seed)["result"] for seed in SEEDS]
    assert min(result["closed"] for result in found) > 10
    assert len({result["trace"][-1][2] for result in found}) == len(found)
    assert plain(EMPTY)["truncated"] is False
    assert plain(3, weeks=5)["result"]["weeks"] == 5


def test_simulations_played_by_others_are_the_plain_model_too():
    expected = [plain(seed, weeks=30)["result"] for seed in SEEDS]
    found = simulate_many(market(30), seeds=SEEDS, collect=lambda simulation: simulation.result, batch_size=2)
    assert exactly(list(found)) == exactly(expected)
    assert exactly(simulate(market(30), seed=3).result) == exactly(expected[0])


def test_another_future_is_drawn_where_the_model_is_seeded_anew():
    environment = raw_env(weeks=30)
    environment.reset(seed=3)
    for _ in range(20):
        environment.step(RULE)
    (same,) = branch(environment, lambda e, i: finished(e))
    one, again, other = branch(environment, lambda e, i: finished(e), 3, seeds=[1, 1, 2])
    assert exactly(same) == exactly(plain(3, weeks=30)["result"])
    assert exactly(one) == exactly(again) != exactly(other)
    assert exactly(one) != exactly(same)
    assert one["trace"][0] == same["trace"][0]
    environment.close()


def finished(environment):
    """What comes out where the rule goes on."""
    while environment.agents:
        *_, terminated, truncated, _ = environment.last()
        environment.step(None if terminated or truncated else RULE)
    return environment.simulation.result


@pytest.mark.greenlet("no environment takes part")
def test_it_speaks_the_wire_as_it_should():
    report = check_wire(example.command(weeks=20))
    assert report.ok, str(report)
    assert len(report.findings) > 10


# -- births, deaths and rewards -------------------------------------------------------------------


def test_lives_begin_and_end_in_mid_episode():
    environment = raw_env()
    turns = play(environment, seed=3)
    times = {}
    for turn in turns:
        times.setdefault(turn.agent, []).append(turn)
    lives = {agent: (life[-1].terminated, life[-1].truncated) for agent, life in times.items()}
    assert set(FARMS + SHOPS) < set(lives)
    assert len(lives) == environment.simulation.result["founded"]
    assert sum(terminated for terminated, _ in lives.values()) == environment.simulation.result["closed"]
    assert all(terminated != truncated for terminated, truncated in lives.values())
    environment.close()


def test_rewards_are_what_was_earned_and_lost():
    """A farm that sows nothing has its upkeep to pay, four weeks at a time, until its money is gone."""
    environment = raw_env()
    turns = play(environment, lambda agent, env: 0 if agent in FARMS else RULE, seed=3)
    lost = set()
    for farm in FARMS:
        _, *rewards = [turn.reward for turn in turns if turn.agent == farm]
        assert rewards[1:-1] == pytest.approx([-16.0] * (len(rewards) - 2))  # the first has the harvest of before
        lost.add(round(rewards[-1], 6))
    assert {-4.0, -8.0} & lost <= lost <= {0.0, -4.0, -8.0, -12.0}  # some give up in the week in which they decide
    environment.close()


def test_the_last_reward_is_of_the_last_week():
    """Shops that ask too much sell nothing: they pay their rent, and what they have baked."""
    environment = raw_env(weeks=2)
    dearly = np.array([PRICES[1]], np.float32)
    turns = play(environment, lambda agent, env: dearly if agent in SHOPS else RULE, seed=3)
    for shop in SHOPS:
        *_, last = [turn for turn in turns if turn.agent == shop]
        _, price, baked, sold, wheat_price, _ = last.observation
        assert (price, sold) == (4.0, 0)
        assert last.reward == pytest.approx(-8 - baked * wheat_price)
    assert turns[-1].truncated
    environment.close()


@pytest.mark.parametrize("view", [raw_env, parallel_env])
def test_prices_and_plots_have_bounds(view):
    environment = view(possible_agents={SOW: FARMS, PRICE: SHOPS}, undeclared="rule")
    environment.reset(seed=3)
    assert environment.possible_agents == FARMS + SHOPS
    assert environment.action_space("farm_1").n == 21
    assert environment.action_space("shop_9").contains(np.array([PRICES[1]], np.float32))
    agent = environment.agents[0] if view is parallel_env else environment.agent_selection
    with pytest.raises(InvalidActionError):
        environment.step({agent: 21} if view is parallel_env else 21)
    environment.close()


# -- side by side ---------------------------------------------------------------------------------


def test_interleaved_they_are_what_they_are_one_by_one():
    before = jvms()
    with ExitStack() as closing:
        environments = [raw_env(weeks=25) for _ in range(8)]
        for seed, environment in enumerate(environments):
            closing.callback(environment.close)
            environment.reset(seed=seed)
        assert len(jvms() - before) == 8
        going = list(environments)
        while going:
            for environment in list(going):
                *_, terminated, truncated, _ = environment.last()
                environment.step(None if terminated or truncated else RULE)
                if not environment.agents:
                    going.remove(environment)
        results = [environment.simulation.result for environment in environments]
    assert exactly(results) == exactly([plain(seed, weeks=25)["result"] for seed in range(8)])
    assert jvms() <= before


def test_where_one_is_killed_the_others_go_on():
    with ExitStack() as closing:
        others = [raw_env(weeks=25) for _ in range(2)]
        for seed, environment in enumerate(others):
            closing.callback(environment.close)
            environment.reset(seed=seed)
        before = jvms()
        killed = raw_env(weeks=25)
        closing.callback(killed.close)
        killed.reset(seed=7)
        (number,) = jvms() - before
        os.kill(number, signal.SIGKILL)
        with pytest.raises(ProcessDiedError, match="SIGKILL"):
            finished(killed)
        assert exactly([finished(environment) for environment in others]) == exactly(
            [plain(seed, weeks=25)["result"] for seed in range(2)]
        )
        killed.reset(seed=7)
        assert exactly(finished(killed)) == exactly(plain(7, weeks=25)["result"])


# -- in the hands of others -----------------------------------------------------------------------

quiet = [
    pytest.mark.filterwarnings(f"ignore:{message}")
    for message in (
        r"\s*This environment does not have possible_agents",  # PettingZoo's rule where no roster is declared
        "No agents present",  # after the end, where there is none
        "Observation numpy array is all zeros",  # all that there is to see of the absent
        "Agents have different (observation|action) space sizes",  # there are two kinds of them
        "The class of action spaces is different",
        "Observations are different shapes",
    )
]
DECLARED = {"possible_agents": {SOW: FARMS, PRICE: SHOPS}, "undeclared": "rule"}


@pytest.mark.parametrize("options", [{}, DECLARED], ids=["as they come", "declared"])
class TestPettingZoo:
    pytestmark = quiet

    def test_turns(self, options):
        with_wrapper = env(weeks=12, **options)
        kit.api_test(with_wrapper, num_cycles=60)
        with_wrapper.close()
        kit.seed_test(lambda: raw_env(weeks=12, **options), num_cycles=30)

    def test_rounds(self, options):
        rounds = parallel_env(weeks=12, **options)
        kit.parallel_api_test(rounds, num_cycles=60)
        rounds.close()
        kit.parallel_seed_test(lambda: parallel_env(weeks=12, **options), num_cycles=30)


@pytest.mark.greenlet("what is compared is tested with both")
def test_other_farmers_are_compared_with_the_rule():
    found = compare(range(3), weeks=30)
    assert list(found.values().columns) == list(CONTENDERS)
    assert found.values("loaves")["by the granary"].mean() > found.values("loaves")["rule"].mean()
    assert set(METRICS) < set(found.frame.columns)
    assert by_the_granary([0, 0, 0, 0.0, 0]) == 20
    assert by_the_granary([0, 0, 0, 1e4, 0]) == 0


# -- how it is compiled ------------------------------------------------------------------------------


@pytest.mark.greenlet("no environment takes part")
def test_errors_of_the_compiler_are_told_and_what_is_compiled_is_kept(tmp_path):
    source = tmp_path / "Town.java"
    source.write_text("class Town { int houses() { return 1; } }")
    out = building.build(tmp_path / "out", [source])
    before = (out / "Town.class").stat().st_mtime_ns
    assert building.build(out, [source]) == out
    assert (out / "Town.class").stat().st_mtime_ns == before
    source.write_text("class Town { int houses() { return 2; } }")
    os.utime(source, (3e9, 3e9))
    building.build(out, [source])
    assert (out / "Town.class").stat().st_mtime_ns > before
    before = (out / "Town.class").stat().st_mtime_ns
    source.write_text("class Town { int houses() { return none; } }")
    os.utime(source, (4e9, 4e9))
    with pytest.raises(RuntimeError, match="cannot find symbol"):
        building.build(out, [source])
    assert (out / "Town.class").stat().st_mtime_ns == before
