"""A simulator in another process is a simulation like any other: every view, and all that is built on simulations."""

import copy
import gc
import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo.test import api_test, parallel_api_test

from simenv_marl import (
    RULE,
    TRUNCATED,
    aec_env,
    branch,
    evaluate,
    generate_env,
    joint_env,
    make_step,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.errors import (
    AgentError,
    BranchError,
    DefinitionError,
    OptionValueError,
    SimulationError,
    UnknownPointError,
    WireError,
)
from simenv_marl.experiments import Variant, design, run_experiment
from simenv_marl.planning import RolloutPolicy
from simenv_marl.plugins import handlers
from simenv_marl.remote import ProcessSimulation
from tests.outside.reservoirs import (
    BOTH,
    BOTH_HERE,
    INFLOW,
    PRICE,
    Here,
    broken,
    by_its_rule,
    command,
    reservoirs,
    told,
)
from tests.processes import gone, runs
from tests.worlds import bare as bare_world
from tests.worlds import outside

ROSTER = {"reservoir.inflow": ["a", "b", *(f"new{number}" for number in range(1, 40))]}


@pytest.fixture
def make_env():
    """Makes environments, and closes them."""
    made = []

    def make(kind, *arguments, **options):
        made.append(kind(*arguments, **options))
        return made[-1]

    yield make
    for env in made:
        env.close()


def child(env):
    """The number of the process of an environment's simulation; None if it has none."""
    found = env.unwrapped.simulation._child
    return None if found is None else found.pid


def all_told(env, seed, choose):
    """All that an AEC environment tells in an episode."""
    env.reset(seed=seed)
    rows = []
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, info = env.last()
        rows.append((agent, observation.tolist(), reward, terminated, truncated, info, list(env.agents)))
        env.step(None if terminated or truncated else choose(agent, env.action_space(agent)))
    return rows


def sampled(agent, space):
    return space.sample()


def ruled(agent, space):
    return RULE


# -- the same as in this process ------------------------------------------------------------------


@pytest.mark.parametrize("choose", [ruled, sampled])
def test_an_episode_is_the_one_of_the_same_model_in_this_process(make_env, choose):
    outside_, here = make_env(aec_env, reservoirs()), make_env(aec_env, Here, BOTH_HERE)
    for seed in range(3):
        theirs, ours = all_told(outside_, seed, choose), all_told(here, seed, choose)
        assert theirs == ours
        assert len({row[0] for row in ours}) > 3  # some are born


def test_rule_is_the_plain_run(make_env):
    env = make_env(aec_env, reservoirs())
    for seed in range(3):
        all_told(env, seed, ruled)
        assert env.unwrapped.simulation.result == by_its_rule(seed)
    plain = subprocess.run(command("2"), capture_output=True, check=True, timeout=60)
    assert json.loads(plain.stdout) == env.unwrapped.simulation.result


def test_every_episode_is_played_by_one_process_which_ends_with_the_environment(make_env):
    env = make_env(aec_env, reservoirs())
    numbers = set()
    for seed in range(3):
        all_told(env, seed, ruled)
        numbers.add(child(env))
    env.reset(seed=3)
    env.step(RULE)
    env.reset(seed=1)  # in mid-episode
    numbers.add(child(env))
    (number,) = numbers
    env.close()
    assert not runs(number)
    all_told(env, 1, ruled)
    assert env.unwrapped.simulation.result == by_its_rule(1)


@pytest.mark.parametrize("truncated", [True, False])
def test_options_arrive_and_ends_are_told(make_env, truncated):
    env = make_env(aec_env, reservoirs())
    env.reset(seed=1, options={"hours": 4, "truncated": truncated})
    while not (any(env.terminations.values()) or any(env.truncations.values())) or env.agent_selection != "price_0":
        _, _, terminated, truncation, _ = env.last()
        env.step(None if terminated or truncation else RULE)
    assert (env.terminations["price_0"], env.truncations["price_0"]) == (not truncated, truncated)
    assert env.unwrapped.simulation.result == by_its_rule(1, hours=4)


def test_a_process_that_exits_after_its_episodes_is_started_anew(make_env):
    env = make_env(aec_env, ProcessSimulation(command("2"), BOTH))
    numbers = []
    for seed in range(5):
        all_told(env, seed, ruled)
        numbers.append(child(env))
        assert env.unwrapped.simulation.result == by_its_rule(seed)
    assert len(set(numbers)) == 3


def test_it_runs_without_an_environment():
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


# -- views and what is built on them --------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::UserWarning")  # of names and spaces
def test_the_views_pass_the_tests_of_pettingzoo(make_env):
    api_test(make_env(aec_env, reservoirs(), possible_agents=ROSTER), num_cycles=60)
    parallel_api_test(make_env(parallel_env, reservoirs(), possible_agents=ROSTER), num_cycles=30)


def test_parallel_rounds_are_those_of_the_same_model_in_this_process(make_env):
    envs = make_env(parallel_env, reservoirs()), make_env(parallel_env, Here, BOTH_HERE)
    seen = []
    for env in envs:
        env.reset(seed=5)
        rows = []
        while env.agents:
            actions = {agent: env.action_space(agent).sample() for agent in env.agents}
            rows.append(
                [
                    {agent: np.asarray(value).tolist() for agent, value in part.items()} if number == 0 else part
                    for number, part in enumerate(env.step(actions))
                ]
            )
        seen.append(rows)
    assert seen[0] == seen[1]


def test_single_and_joint_and_vector_views(make_env):
    env = make_env(single_env, reservoirs(), "broker.price")
    assert env.reset(seed=1)[0] == env.reset(seed=1)[0]
    assert env.step(2)[2] is False
    one = make_env(single_env, reservoirs(), "reservoir.inflow", agent="b")
    assert one.reset(seed=1)[0].tolist()[1] == 0.0
    joint = make_env(joint_env, reservoirs(), "broker.price")
    assert joint.reset(seed=1)[0].keys() == {"price_0"}
    many = make_env(vector_env, reservoirs(), "broker.price", num_envs=3)
    observations, _ = many.reset(seed=[1, 2, 1])
    assert observations[0] == observations[2] != observations[1]
    many.step(np.array([0, 1, 0]))


def test_generate_env_makes_the_single_view_of_one_point(make_env):
    made = generate_env(reservoirs(), "broker.price")
    assert made().unwrapped.simulation.points.keys() == reservoirs().points.keys()


def test_policies_answer_by_agent_and_by_point():
    seen = []

    def half(observation):
        seen.append(observation)
        return 0

    simulation = simulate(reservoirs(), {"broker.price": half, "a": lambda observation: np.zeros(1)}, seed=1)
    assert simulation.result["price"] == 0.5
    assert len(seen) == 4
    assert simulation._child is None
    assert simulate(reservoirs(), seed=1).result == by_its_rule(1)
    env = aec_env(reservoirs(), "reservoir.inflow", policies={"broker.price": lambda observation: 2})  # was not named
    all_told(env, 1, ruled)
    assert env.unwrapped.simulation.result["price"] == 2.0
    env.close()


def test_points_may_be_given_other_definitions(make_env):
    other = make_env(aec_env, reservoirs({**BOTH, "broker.price": INFLOW}), {"broker.price": PRICE})
    all_told(other, 1, lambda agent, space: 1)
    assert other.unwrapped.simulation.result["price"] == 1.0
    rows = all_told(make_env(aec_env, reservoirs(), {"reservoir.inflow": INFLOW}), 1, ruled)
    assert any(row[3] for row in rows)  # under another definition, too, the gone are removed


@pytest.mark.parametrize("workers", [0, 2])
def test_simulate_many_and_evaluate(workers):
    results = simulate_many(
        reservoirs(), {"broker.price": lambda observations: np.ones(len(observations), int)}, seeds=range(4),
        collect=lambda simulation: simulation.result["price"], workers=workers,
    )  # fmt: skip
    assert results == [1.0] * 4
    found = evaluate(
        reservoirs(), {"rule": {}, "cheap": {"broker.price": _cheap}}, seeds=range(4), baseline="rule", workers=workers,
        metric={"price": _price},
    )  # fmt: skip
    prices = found.frame[found.frame.agent == "team"].set_index(["contender", "seed"]).price
    assert prices["cheap"].tolist() == [0.5] * 4
    assert prices["rule"].tolist() == [by_its_rule(seed)["price"] for seed in range(4)]


def test_what_the_process_told_comes_back_from_workers():
    simulations = simulate_many(reservoirs({"broker.price": _PLAIN}), {}, seeds=range(2), workers=2)
    assert [simulation.result for simulation in simulations] == [by_its_rule(0), by_its_rule(1)]


def _cheap(observation):
    return 0


def _price(simulation):
    return simulation.result["price"]


def test_handlers_extend_decisions_by_their_name(make_env):
    seen = []
    env = make_env(aec_env, reservoirs(), plugins=[(lambda call: seen.append(call.total), "broker.price", "before")])
    all_told(env, 1, ruled)
    assert len(seen) == 4
    with handlers((lambda call: 7.0, "broker.price", "instead")):
        assert simulate(reservoirs(), seed=1).result["price"] == 7.0
    assert env.unwrapped.simulation.result == by_its_rule(1)


# -- names, and what may be left out --------------------------------------------------------------

PLAIN = make_step(
    observation_space=spaces.Discrete(2),
    observation_space_mapping=lambda call: call["entity"] is call.entity is None and call["time"] is call.time is None,
    action_space=spaces.Discrete(3),
    action_space_mapping={0: "none", 1: None, 2: {"some": [1.5]}},
    reward_mapping=lambda call: float(len(call)),
)


def bare(*points, definitions=None):
    """A simulator that sends as little as it may."""
    command = [sys.executable, bare_world.__file__, *points]
    return ProcessSimulation(command, definitions or dict.fromkeys(points, PLAIN))


@pytest.mark.parametrize("name", ["rate", "a:b/ü", "42", "a.", "json.dumps", "math.sin", "tests.worlds.bare.main"])
def test_points_may_have_any_name_also_that_of_a_function(make_env, name):
    before, seen = json.dumps, []
    env = make_env(aec_env, bare(name), name, plugins=[(lambda call: seen.append(call.point), name, "before")])
    all_told(env, 1, lambda agent, space: 2)
    assert env.unwrapped.simulation.result == [{"some": [1.5]}] * 6
    assert seen == [name] * 6
    assert simulate(bare(name), {name: lambda observation: 0}, seed=1).result == ["none"] * 6
    assert json.dumps is before
    all_told(env, 2, ruled)
    assert env.unwrapped.simulation.result == [None] * 6


def test_another_point_of_the_process_may_end_an_agent(make_env):
    ending = replace(PLAIN, agent="mill", removed_by={"mill.sold": lambda call: "mill"})
    mill = bare("mill.rate", "mill.sold", definitions={"mill.rate": ending, "mill.sold": PLAIN})
    env = make_env(aec_env, mill, "mill.rate")
    env.reset(seed=1)
    env.step(0)
    with pytest.raises(AgentError, match=r"decides at mill\.rate after its end"):
        env.step(0)


def test_apply_answers_with_what_it_returns(make_env):
    answer = replace(PRICE, action_space_mapping=None, apply=lambda action, call: float(action) + call.total)
    env = make_env(aec_env, reservoirs({"broker.price": answer}))
    env.reset(seed=1, options={"hours": 3})
    total = env.last()[0][0]
    env.step(2)
    assert env.unwrapped.simulation.result["price"] == 2 + total
    rule = replace(PRICE, action_space_mapping=None, apply=lambda action, call: RULE)
    other = make_env(aec_env, reservoirs({"broker.price": rule}))
    all_told(other, 1, sampled)
    assert other.unwrapped.simulation.result == by_its_rule(1)


def test_variants_and_specs_carry_it(make_env):
    env = make_env(aec_env, Variant("patient", _patient, parameters={"timeout": 5.0}))
    assert env.unwrapped.simulation.timeout == 5.0


def _patient(words=None, timeout=30.0):
    return ProcessSimulation(words or command(), BOTH, timeout=timeout)


# -- branches and planning ------------------------------------------------------------------------


def test_branches_by_replay_are_exact_and_forks_are_refused(make_env, request):
    env = make_env(aec_env, reservoirs())
    env.reset(seed=3)
    for _ in range(7):
        env.step(RULE)
    if env.unwrapped.driver == "greenlet":
        with pytest.raises(BranchError, match="child process"):
            branch(env, _played_out, method="fork")
    one, two = branch(env, _played_out, 2)
    while env.agents:
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else RULE)
    assert one == two == env.unwrapped.simulation.result == by_its_rule(3)


def _played_out(env, number):
    while env.agents:
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else RULE)
    return env.unwrapped.simulation.result


def test_other_futures_are_drawn_in_the_process(make_env):
    env = make_env(aec_env, reservoirs())
    env.reset(seed=3)
    for _ in range(5):
        env.step(RULE)
    one, again, other = branch(env, _played_out, 3, seeds=[1, 1, 2])
    assert one == again != other
    here = make_env(aec_env, Here, BOTH_HERE)
    here.reset(seed=3)
    for _ in range(5):
        here.step(RULE)
    (mine,) = branch(here, lambda env, number: told(_played(env).model.result()), 1, seeds=[1], method="replay")
    assert mine == one


def _played(env):
    _played_out_plainly(env)
    return env.unwrapped.simulation


def _played_out_plainly(env):
    while env.agents:
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else RULE)


def test_a_process_that_cannot_reseed_says_so(make_env):
    env = make_env(single_env, broken("in mid-episode", "exit"), "reservoir.inflow", agent="a")
    env.reset(seed=1)
    env.unwrapped.simulation._child.can = frozenset()
    with pytest.raises(BranchError, match="reseed"):
        env.unwrapped.simulation.reseed(3)


def test_a_planner_decides():
    planner = RolloutPolicy([0, 1, 2], futures=1, horizon=2)
    simulation = simulate(reservoirs(), {"broker.price": planner}, seed=1)
    assert simulation.result["price"] in (0.5, 1.0, 2.0)


# -- processes that are kept ----------------------------------------------------------------------


@pytest.fixture
def started(tmp_path):
    """A simulation whose processes leave a line where they begin, and how many there were."""
    log = tmp_path / "started"
    script = f'echo x >> {log}; exec "$@"'
    simulation = ProcessSimulation(["sh", "-c", script, "sh", *command()], BOTH)
    return simulation, lambda: log.read_text().count("x")


def test_many_simulations_share_a_process(started, tmp_path):
    simulation, number = started
    evaluate(simulation, {"rule": {}, "cheap": {"broker.price": _cheap}}, seeds=range(5))
    assert number() == 1
    prices = simulate_many(simulation, {}, seeds=range(5), collect=_price)
    assert (prices, number()) == ([by_its_rule(seed)["price"] for seed in range(5)], 2)
    run_experiment(
        partial(_patient, simulation.command), design({"timeout": [10.0, 20.0]}), seeds=range(3),
        store=tmp_path / "store", metric={"price": _price},
    )  # fmt: skip
    assert number() == 4  # one for each time limit
    env = aec_env(simulation)
    env.reset(seed=3)
    env.step(RULE)
    assert len({str(result) for result in branch(env, _played_out, 4)}) == 1
    env.close()
    assert number() == 6


def test_processes_that_are_kept_end_with_what_has_run(started):
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


def test_a_process_that_exits_after_a_stop_is_started_anew(make_env, tmp_path):
    script = tmp_path / "once.py"
    folder = outside.__file__.rpartition("/")[0]
    script.write_text(
        f"import os, sys\nsys.path.insert(0, {folder!r})\nimport outside\n"
        "class Once(outside.Reservoirs):\n"
        "    def run(self, *given):\n"
        "        try:\n            super().run(*given)\n"
        "        except outside.Stopped:\n            os._exit(0)\n"
        "outside.Wire().play(Once, outside.POINTS)\n"
    )
    env = make_env(aec_env, ProcessSimulation([sys.executable, str(script)], BOTH))
    env.reset(seed=1)
    env.step(RULE)
    number = child(env)
    all_told(env, 1, ruled)
    assert child(env) != number
    assert env.unwrapped.simulation.result == by_its_rule(1)


# -- copies, processes, threads -------------------------------------------------------------------


def test_copies_are_made_of_the_same_and_have_processes_of_their_own(make_env):
    env = make_env(aec_env, reservoirs())
    all_told(env, 1, ruled)
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(aec_env(reservoirs({"broker.price": _PLAIN}))))):
        assert child(twin) is None
        twin.reset(seed=1)
        assert child(twin) not in (None, child(env))
        twin.close()


def _level(call):
    return [call.total]


def _nothing(call):
    return 0.0


_PLAIN = make_step(
    observation_space=spaces.Box(-500, 500, (1,), np.float64),
    observation_space_mapping=_level,
    action_space=spaces.Discrete(2),
    action_space_mapping={0: 0.5, 1: 1.0},
    reward_mapping=_nothing,
)


def test_the_environment_variables_may_be_those_of_this_process():
    assert pickle.loads(pickle.dumps(reservoirs({"broker.price": _PLAIN}, env=os.environ))).env == dict(os.environ)


def test_calls_can_be_copied():
    seen = []

    def look(call):
        seen.append((copy.copy(call), copy.deepcopy(call), pickle.loads(pickle.dumps(call))))
        return [call.total]

    watched = replace(_PLAIN, observation_space_mapping=look)
    simulate(reservoirs({"broker.price": watched}), {"broker.price": _cheap}, seed=1)
    assert len({repr(copied) for copied, _, _ in seen}) == len(seen) == 4
    for copies in seen:
        assert {(each.total, each.time, each.point, each.entity) for each in copies} == {
            (copies[0].total, copies[0].time, "broker.price", None)
        }


def test_processes_interleaved_are_those_run_one_by_one(make_env):
    envs = [make_env(aec_env, reservoirs()) for _ in range(8)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
    waiting = list(envs)
    while waiting:
        for env in list(waiting):
            if not env.agents:
                waiting.remove(env)
                continue
            _, _, terminated, truncated, _ = env.last()
            env.step(None if terminated or truncated else RULE)
    assert [env.unwrapped.simulation.result for env in envs] == [by_its_rule(seed) for seed in range(8)]


def test_an_environment_that_is_gone_takes_its_process_along():
    env = aec_env(reservoirs())
    env.reset(seed=1)
    env.step(RULE)
    number = child(env)
    assert runs(number)
    del env
    gc.collect()
    assert not runs(number)


def test_a_fork_ends_no_process_of_its_parent(make_env):
    env = make_env(aec_env, reservoirs())
    env.reset(seed=1)
    number = child(env)
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            simulation = env.unwrapped.simulation
            simulation._child.close()
            del simulation
            env.close()
            code = 0
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert runs(number)
    while env.agents:
        _, _, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else RULE)
    assert env.unwrapped.simulation.result == by_its_rule(1)


def test_the_process_ends_with_the_one_that_has_started_it():
    script = (
        "import os; from tests.outside.reservoirs import reservoirs; from simenv_marl import aec_env;"
        "env = aec_env(reservoirs()); env.reset(seed=1);"
        "print(env.unwrapped.simulation._child.pid, flush=True); os._exit(1)"
    )
    told_ = subprocess.run([sys.executable, "-c", script], capture_output=True, timeout=60, cwd=Path.cwd())
    number = int(told_.stdout)
    assert gone(number)


# -- bad input ------------------------------------------------------------------------------------


_ROUND: list = []
_ROUND.append(_ROUND)


@pytest.mark.parametrize(
    "options", [{"a": object()}, {"a": {1: 2}}, {"a": {3}}, {"a": [b"bytes"]}, {"a": _ROUND}, {"a": 10**5000}]
)
def test_options_that_are_no_json_are_refused_before_anything_is_sent(make_env, options):
    env = make_env(aec_env, reservoirs())
    env.reset(seed=1)
    number = child(env)
    with pytest.raises(WireError, match="a"):
        env.reset(seed=1, options=options)
    assert child(env) == number
    all_told(env, 1, ruled)
    assert env.unwrapped.simulation.result == by_its_rule(1)


def test_a_decision_that_is_no_json_is_told_with_its_point(make_env):
    env = make_env(aec_env, reservoirs({"broker.price": replace(PRICE, action_space_mapping=lambda action: {1, 2})}))
    env.reset(seed=1)
    with pytest.raises(WireError, match="not JSON") as caught:
        env.step(1)
    assert "broker.price" in "".join(caught.value.__notes__)
    all_told(env, 1, ruled)
    assert env.unwrapped.simulation.result == by_its_rule(1)


@pytest.mark.parametrize("wrong", ["", [], [3], None, 7])
def test_a_command_that_is_none(wrong):
    if wrong == "":
        with pytest.raises(Exception, match="cannot be started"):
            aec_env(ProcessSimulation(wrong, BOTH)).reset()
        return
    with pytest.raises(OptionValueError, match="command"):
        ProcessSimulation(wrong, BOTH)


def test_other_bad_input():
    for timeout in (0, -1, None, "long", True):
        with pytest.raises(OptionValueError, match="timeout"):
            reservoirs(timeout=timeout)
    for points in (None, {}, [], {"a": 3}, {3: INFLOW}, {"": INFLOW}):
        with pytest.raises(DefinitionError, match="points"):
            reservoirs(points)
    with pytest.raises(UnknownPointError, match=r"moon\.phase.*broker\.price, reservoir\.inflow"):
        aec_env(reservoirs({**BOTH, "moon.phase": PRICE})).reset()
    with pytest.raises(UnknownPointError):
        aec_env(reservoirs(), "moon.phase")
    with pytest.raises(AttributeError, match=r"reservoir\.inflow has no argument 'depth'; it has level"):
        aec_env(reservoirs({"reservoir.inflow": replace(INFLOW, reward_mapping=lambda call: call.depth)})).reset()
