"""A simulator in another process is like any other simulation, in every view and application."""

import copy
import gc
import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    TRUNCATED,
    aec_env,
    branch,
    evaluate,
    joint_env,
    make_step,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.errors import (
    BranchError,
    DefinitionError,
    OptionValueError,
    SimulationError,
    UnknownPointError,
    WireError,
)
from simenv_marl.experiments import design, run_experiment
from simenv_marl.plugins import handlers
from simenv_marl.remote import ProcessSimulation
from tests.outside.reservoirs import (
    BOTH,
    INFLOW,
    PRICE,
    by_its_rule,
    child,
    command,
    plays_by_its_rule,
    reservoirs,
)
from tests.processes import runs
from tests.worlds import outside
from tests.worlds.models import begun, play


def _cheap(observation):
    return 0


def test_process_simulation_with_rule_actions_runs_like_without_env(make_env):
    env = make_env(aec_env, reservoirs())
    numbers = set()
    for seed in range(3):
        assert plays_by_its_rule(env, seed)
        numbers.add(child(env))
    plain = subprocess.run(command("2"), capture_output=True, check=True, timeout=60)
    assert json.loads(plain.stdout) == env.simulation.result
    env.reset(seed=3)
    env.step(RULE)
    assert plays_by_its_rule(env)  # after an episode that was broken off
    numbers.add(child(env))
    (number,) = numbers
    env.close()
    assert not runs(number)
    assert plays_by_its_rule(env)


def test_process_simulation_gets_reset_options_and_reports_truncation(make_env):
    env = make_env(aec_env, reservoirs())
    env.reset(seed=1, options={"hours": 4, "truncated": True})
    *_, last = play(env, reset=False)
    assert (last.terminated, last.truncated) == (False, True)
    assert env.simulation.result == by_its_rule(1, hours=4)


def test_process_simulation_restarts_a_process_that_has_exited(make_env):
    env = make_env(aec_env, ProcessSimulation(command("2"), BOTH))
    numbers = set()
    for seed in range(5):
        assert plays_by_its_rule(env, seed)
        numbers.add(child(env))
    assert len(numbers) == 3


def test_process_simulation_runs_without_an_environment():
    simulation = reservoirs()
    simulation.reset(4)
    assert simulation.run() is None
    assert simulation.result == by_its_rule(4)
    with pytest.raises(SimulationError, match="call reset"):
        simulation.run()
    simulation.reset(4, {"truncated": True})
    assert simulation.run() is TRUNCATED
    number = simulation._child.pid
    simulation.close()
    assert not runs(number)


def test_process_simulation_works_in_single_joint_and_vector_env(make_env):
    one = make_env(single_env, reservoirs(), "reservoir.inflow", agent="b")
    assert one.reset(seed=1)[0].tolist()[1] == 0.0
    joint = make_env(joint_env, reservoirs(), "broker.price")
    assert joint.reset(seed=1)[0].keys() == {"price_0"}
    many = make_env(vector_env, reservoirs(), "broker.price", num_envs=3)
    observations, _ = many.reset(seed=[1, 2, 1])
    assert observations[0] == observations[2] != observations[1]
    many.step(np.array([0, 1, 0]))


def test_process_simulation_policies_answer_by_agent_and_by_decision_point(make_env):
    simulation = simulate(
        reservoirs(), {"broker.price": _cheap, "a": lambda observation: np.zeros(1)}, seed=1
    )
    assert simulation.result["price"] == 0.5
    assert simulation._child is None
    assert simulate(reservoirs(), seed=1).result == by_its_rule(1)
    not_named = {"broker.price": lambda observation: 2}
    env = make_env(aec_env, reservoirs(), "reservoir.inflow", policies=not_named)
    play(env, seed=1)
    assert env.simulation.result["price"] == 2.0


def test_process_simulation_sends_the_result_of_apply(make_env):
    answer = replace(
        PRICE, action_space_mapping=None, apply=lambda action, call: float(action) + call.total
    )
    env = make_env(aec_env, reservoirs({**BOTH, "broker.price": INFLOW}), {"broker.price": answer})
    *_, last, _ = play(env, 1, seed=1)
    assert env.simulation.result["price"] == 1 + last.observation[0]
    other = make_env(aec_env, reservoirs(), {"reservoir.inflow": INFLOW})
    assert any(turn.terminated for turn in play(other, seed=1))  # here, too, the gone are removed


def _price(simulation):
    return simulation.result["price"]


@pytest.mark.parametrize("workers", [0, 2])
def test_process_simulation_works_in_simulate_many_and_evaluate(workers):
    policies = {"broker.price": lambda observations: np.ones(len(observations), int)}
    found = simulate_many(
        reservoirs({"broker.price": PRICE}), policies, seeds=range(4), workers=workers
    )
    assert [simulation.result["price"] for simulation in found] == [1.0] * 4
    contenders = {"rule": {}, "cheap": {"broker.price": _cheap}}
    compared = evaluate(
        reservoirs(),
        contenders,
        seeds=range(4),
        baseline="rule",
        workers=workers,
        metric={"price": _price},
    )
    prices = compared.frame[compared.frame.agent == "team"].set_index(["contender", "seed"]).price
    assert prices["cheap"].tolist() == [0.5] * 4
    assert prices["rule"].tolist() == [by_its_rule(seed)["price"] for seed in range(4)]


PLAIN = make_step(
    observation_space=spaces.Discrete(2),
    observation_space_mapping=lambda call: (
        call["entity"] is call.entity is None and call["time"] is call.time is None
    ),
    action_space=spaces.Discrete(3),
    action_space_mapping={0: "none", 1: None, 2: {"some": [1.5]}},
    reward_mapping=lambda call: float(len(call)),
)


@pytest.mark.parametrize(
    "name", ["rate", "a:b/ü", "42", "a.", "json.dumps", "math.sin", "tests.worlds.outside.main"]
)
def test_process_simulation_points_can_have_any_name(make_env, name):
    before, seen = json.dumps, []
    # sends as little as it may
    simulation = ProcessSimulation([sys.executable, outside.__file__, "bare", name], {name: PLAIN})
    env = make_env(
        aec_env, simulation, name, plugins=[(lambda call: seen.append(call.point), name, "before")]
    )
    play(env, 2, seed=1)
    assert env.simulation.result == [{"some": [1.5]}] * 6
    assert seen == [name] * 6
    assert simulate(simulation, {name: lambda observation: 0}, seed=1).result == ["none"] * 6
    assert json.dumps is before
    play(env, seed=2)
    assert env.simulation.result == [None] * 6


def test_process_simulation_plugins_extend_decisions_by_name(make_env):
    assert plays_by_its_rule(make_env(aec_env, reservoirs()))
    with handlers((lambda call: 7.0, "broker.price", "instead")):
        assert simulate(reservoirs(), seed=1).result["price"] == 7.0


def _begun(env, steps):
    env.reset(seed=3)
    for _ in range(steps):
        env.step(RULE)
    return env


def _played_out(env, number=0):
    play(env, reset=False)
    return env.simulation.result


def test_process_simulation_branches_by_replay_and_refuses_forks(make_env):
    env = _begun(make_env(aec_env, reservoirs()), 7)
    if env.unwrapped.driver == "greenlet":
        with pytest.raises(BranchError, match="child process"):
            branch(env, _played_out, method="fork")
    assert [*branch(env, _played_out, 2), _played_out(env)] == [by_its_rule(3)] * 3


def test_process_simulation_draws_other_futures_by_reseed(make_env):
    env = _begun(make_env(aec_env, reservoirs()), 5)
    one, again, other = branch(env, _played_out, 3, seeds=[1, 1, 2])
    assert one == again != other


def test_process_simulation_that_cannot_reseed_raises_an_error():
    simulation = begun(
        ProcessSimulation([sys.executable, outside.__file__, "bare", "rate"], {"rate": PLAIN}), 1
    )
    with pytest.raises(BranchError, match='has not announced "reseed"'):
        simulation.reseed(3)
    simulation.close()


@pytest.fixture
def started(tmp_path):
    """A simulation whose processes leave a line where they begin, and how many there were."""
    log = tmp_path / "started"
    script = f'echo x >> {log}; exec "$@"'
    simulation = ProcessSimulation(["sh", "-c", script, "sh", *command()], BOTH)
    return simulation, lambda: log.read_text().count("x")


def _patient(words, timeout=30.0):
    return ProcessSimulation(words, BOTH, timeout=timeout)


def test_process_simulation_shares_one_process_among_many_runs(started, make_env, tmp_path):
    simulation, number = started
    evaluate(simulation, {"rule": {}, "cheap": {"broker.price": _cheap}}, seeds=range(5))
    assert number() == 1
    prices = simulate_many(simulation, {}, seeds=range(5), collect=_price)
    assert (prices, number()) == ([by_its_rule(seed)["price"] for seed in range(5)], 2)
    factory, runs = partial(_patient, simulation.command), design({"timeout": [10.0, 20.0]})
    run_experiment(
        factory, runs, seeds=range(3), store=tmp_path / "store", metric={"price": _price}
    )
    assert number() == 4  # one for each time limit
    env = _begun(make_env(aec_env, simulation), 1)
    assert branch(env, _played_out, 4) == [by_its_rule(3)] * 4
    assert number() == 6


def test_process_simulation_process_ends_with_simulate_many(started):
    numbers = []

    def notice(simulation):
        numbers.append(simulation._child.pid)
        return 1 / (3 - len(numbers))

    with pytest.raises(ZeroDivisionError):
        simulate_many(started[0], {}, seeds=range(3), collect=notice)
    assert len(numbers) == 3
    assert len(set(numbers)) == 1
    assert not runs(numbers[0])
    assert len(simulate_many(started[0], {}, seeds=range(3), collect=notice)) == 3
    assert not runs(numbers[-1])


def test_process_simulation_process_ends_when_its_env_is_dropped():
    env = begun(aec_env(reservoirs()), 1)
    env.step(RULE)
    number = child(env)
    assert runs(number)
    del env
    gc.collect()
    assert not runs(number)


def test_process_simulation_copies_have_processes_of_their_own(make_env):
    env = begun(make_env(aec_env, reservoirs()), 1)
    other = aec_env(reservoirs({"broker.price": PRICE}, env=MappingProxyType({**os.environ})))
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(other))):
        assert child(twin) is None
        twin.reset(seed=1)
        assert child(twin) not in (None, child(env))
        twin.close()


def test_process_simulation_calls_can_be_copied_and_pickled():
    copies = []

    def look(call):
        copied = copy.copy(call), copy.deepcopy(call), pickle.loads(pickle.dumps(call))
        copies.append((call.total, call.time, copied))
        return [call.total]

    watched = replace(PRICE, observation_space_mapping=look)
    simulate(reservoirs({"broker.price": watched}), {"broker.price": _cheap}, seed=1)
    assert len({total for total, *_ in copies}) == 4
    for total, time, copied in copies:
        for call in copied:
            assert (call.total, call.time, call.point, call.entity) == (
                total,
                time,
                "broker.price",
                None,
            )
    with pytest.raises(KeyError, match=r"broker\.price has no argument 'rain'; it has total"):
        call["rain"]


def test_process_simulation_refuses_values_that_are_no_json(make_env):
    env = begun(
        make_env(
            aec_env,
            reservoirs(
                {"broker.price": replace(PRICE, action_space_mapping=lambda action: {1, 2})}
            ),
        ),
        1,
    )
    number = child(env)
    with pytest.raises(WireError, match="'a'"):
        env.reset(seed=1, options={"a": {3}})
    assert child(env) == number
    assert plays_by_its_rule(env)
    env.reset(seed=1)
    with pytest.raises(WireError, match="not JSON") as caught:
        env.step(1)
    assert "in the decision of" in "".join(caught.value.__notes__)
    assert plays_by_its_rule(env)


def test_process_simulation_refuses_invalid_options():
    for wrong in ([], [3], None, 7):
        with pytest.raises(OptionValueError, match="command"):
            ProcessSimulation(wrong, BOTH)
    for timeout in (0, -1, None, "long", True):
        with pytest.raises(OptionValueError, match="timeout"):
            reservoirs(timeout=timeout)
    assert reservoirs(timeout=np.int64(3)).timeout == 3.0
    for env in ({"SEEDS": 1}, {1: "seeds"}, "SEEDS=1"):
        with pytest.raises(OptionValueError, match="env must be a dict"):
            reservoirs(env=env)
    with pytest.raises(OptionValueError, match="cwd must be the path of a folder, not 5"):
        reservoirs(cwd=5)
    for points in (None, {}, [], {"a": 3}, {3: INFLOW}, {"": INFLOW}):
        with pytest.raises(DefinitionError, match="points"):
            reservoirs(points)
    with pytest.raises(UnknownPointError, match=r"moon\.phase.*broker\.price, reservoir\.inflow"):
        aec_env(reservoirs({**BOTH, "moon.phase": PRICE})).reset()
    with pytest.raises(UnknownPointError):
        aec_env(reservoirs(), "moon.phase")
    with pytest.raises(
        AttributeError, match=r"reservoir\.inflow has no argument 'depth'; it has level"
    ):
        aec_env(
            reservoirs(
                {"reservoir.inflow": replace(INFLOW, reward_mapping=lambda call: call.depth)}
            )
        ).reset()


TANKS = """
import json, os
reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
commands = os.fdopen(reading)

def send(frame):
    os.write(writing, json.dumps(frame).encode() + b"\\n")

send({"hello": 1, "points": ["tank", "other"], "can": ["expect"]})
for line in commands:
    if "start" not in json.loads(line):
        continue
    for frame in FIRST:
        send(frame)
    for number in (1, 2, 3):
        send({"decide": number, "point": "tank", "entity": "a", "time": 0.5 * number, "args": {}})
        if "stop" in json.loads(commands.readline()):
            break
    else:
        send({"end": {}})
"""


@pytest.mark.parametrize(
    "first",
    [
        [{"expect": [{"point": "tank", "entity": "b", "args": {}}]}],
        [{"expect": [{"point": "tank", "entity": "b"}]}, {"remove": "b", "point": "tank"}],
        [{"update": "a", "point": "tank", "args": {}}, {"update": "a", "point": "other"}],
        [{"expect": []}],
        [{"expect": [{"point": "tank", "entity": "a", "time": 0.25}]}],
        [],
    ],
    ids=str,
)
def test_process_simulation_knows_the_time_from_the_first_frame(first):
    seen = []

    def observe(call):
        seen.append((call.entity, call.time))
        return [0.0]

    definition = make_step(
        observation_space=spaces.Box(-1, 1, (1,), np.float64),
        observation_space_mapping=observe,
        action_space=spaces.Discrete(2),
        action_space_mapping=int,
        reward_mapping=lambda call: 1.0,
        agent=lambda call: call.entity,
    )
    source = f"FIRST = {first!r}{TANKS}"
    simulation = ProcessSimulation([sys.executable, "-c", source], {"tank": definition})
    env = single_env(simulation, agent="a", discount_rate=1.0)
    for _ in range(2):
        infos = [env.reset(seed=1)[1], *(env.step(0)[-1] for _ in range(3))]
        assert [info["time"] for info in infos] == [0.5, 1.0, 1.5, 1.5]
        assert [info["elapsed"] for info in infos] == [0.0, 0.5, 0.5, 0.0]
        assert infos[1]["discount"] == pytest.approx(np.exp(-0.5))
    assert set(seen) >= {("a", 0.5), ("a", 1.0), ("a", 1.5)}
    env.close()
