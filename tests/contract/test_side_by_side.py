"""Section 5.10 of the contract, and models that switch stacks of their own: SimPy, generators, greenlets, asyncio."""

import asyncio
import decimal
import gc
import logging
import random
import re
import subprocess
import sys
from functools import partial
from textwrap import dedent

import greenlet
import pytest
import simpy

from simenv_marl import RULE, aec_env, difference, generate_env, single_env
from tests.worlds.models import (
    Script,
    calling,
    decision,
    decisions,
    define,
    play,
    rewards_of,
    script,
    stacks,
    unwinding,
)

VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])


# -- interleaved ----------------------------------------------------------------------------------


@define(agent="spender_0")
def spend(draw):
    return draw.randrange(3)


@define(agent="earner_0")
def earn(draw):
    return -draw.randrange(5)


def banking(simulation):
    draw = random.Random(simulation.seed)
    for _ in range(12):
        simulation.log.append(spend(draw) if draw.random() < 0.7 else earn(draw))


def plain_log(make, seed=None):
    """What a simulation logs without an environment."""
    simulation = make()
    simulation.reset(seed)
    simulation.run()
    return simulation.log


def test_some_may_run_their_rule_and_others_be_decided():
    envs = [aec_env(script(banking), points) for points in (spend, earn, [spend, earn])]
    for env in envs:
        env.reset(seed=4)
    while any(env.agents for env in envs):
        for env in envs:
            if env.agents:
                env.step(None if env.last()[2] else RULE)
    assert [env.unwrapped.simulation.log for env in envs] == [plain_log(script(banking), 4)] * 3


# -- nested ---------------------------------------------------------------------------------------


def inner_env():
    return single_env(calling(*[INNER] * 3), INNER)


INNER = decision(lambda: "inner rule", agent="inner_0", reward_mapping=difference(lambda: 1))


def run_inner(env, action):
    env.reset()
    while not env.step(action)[2]:
        pass
    return env.unwrapped.simulation.log


@pytest.mark.parametrize("action", [4, RULE])
@pytest.mark.parametrize("also_outer", [False, True])
def test_a_rule_may_run_an_environment_of_its_own(action, also_outer):
    inner = inner_env()
    outer = decision(lambda: list(run_inner(inner, action)), agent="outer_0")
    points = [outer, INNER] if also_outer else [outer]
    env = aec_env(calling(outer, INNER, outer), points)
    turns = play(env, {"outer_0": RULE, "inner_0": 9})
    # What the inner environment decides is no decision of the outer one, even where that has the same point.
    assert decisions(turns) == (["outer_0", "inner_0", "outer_0"] if also_outer else ["outer_0", "outer_0"])
    expected = [action if action == 4 else "inner rule"] * 3
    assert env.unwrapped.simulation.log == [expected, 9 if also_outer else "inner rule", expected]


def test_an_inner_environment_may_be_stepped_from_inside_and_from_outside_in_turn():
    inner = single_env(calling(*[INNER] * 6), INNER)
    outer = decision(lambda: inner.step(1)[2], agent="outer_0")
    env = single_env(calling(*[outer] * 3), outer)
    inner.reset()
    env.reset()
    for _ in range(3):
        inner.step(2)
        env.step(RULE)
    assert inner.unwrapped.simulation.log == [2, 1] * 3
    inner.reset()
    inner.step(3)
    inner.close()


@pytest.mark.parametrize("source", ["class", "factory", "generate_env"])
def test_decisions_while_an_inner_simulation_is_made_reset_or_stopped_are_nobodys(source):
    seen = []

    class Inner(Script):
        def __init__(self):
            super().__init__(lambda simulation: INNER())
            seen.append(("made", INNER()))

        def reset(self, seed=None):
            super().reset(seed)
            seen.append(("reset", INNER()))

        def stop(self):
            seen.append(("stopped", INNER()))

        def render(self, mode):
            seen.append(("rendered", INNER()))

    def rule():
        make = generate_env(Inner, INNER) if source == "generate_env" else partial(single_env, kind, INNER)
        inner = make(render_mode="ansi")
        inner.reset()
        inner.render()
        inner.reset()
        inner.close()

    kind, outer = (lambda: Inner()) if source == "factory" else Inner, decision(rule, agent="outer_0")
    env = aec_env(calling(outer, INNER), [outer, INNER])
    assert decisions(play(env, {"outer_0": RULE, "inner_0": 9})) == ["outer_0", "inner_0"]
    done = [what for what, _ in seen if what != "made"]
    assert done == ["reset", "rendered", "stopped", "reset", "stopped"]
    assert {value for _, value in seen} == {"inner rule"}


def test_an_inner_environment_may_be_abandoned_inside():
    unwound = []

    def main(simulation):
        try:
            INNER()
        finally:
            unwound.append(INNER())

    def rule():
        single_env(script(main), INNER).reset()
        gc.collect()
        return INNER()

    outer = decision(rule, agent="outer_0")
    env = aec_env(calling(outer), [outer, INNER])
    assert decisions(play(env, {"outer_0": RULE, "inner_0": 9})) == ["outer_0", "inner_0"]
    assert env.unwrapped.simulation.log == [9]
    assert not unwound


@pytest.mark.parametrize(
    "name", ["observation_space_mapping", "reward_mapping", "action_space_mapping", "agent", "policy"]
)
def test_mappings_and_policies_may_run_an_environment_of_their_own(name):
    inner, logs = inner_env(), []
    value = {"observation_space_mapping": [0, 0], "reward_mapping": 0, "agent": "outer_0"}.get(name, 7)

    def nested(*args):
        logs.append(list(run_inner(inner, 4)))
        return value

    other = decision(agent="other_0")
    mapping = difference(nested) if name == "reward_mapping" else nested
    outer = decision(**{"agent": "outer_0"} | ({} if name == "policy" else {name: mapping}))
    policies = {outer: nested} if name == "policy" else None
    env = aec_env(calling(outer, other, outer, INNER), [outer, other, INNER], policies=policies)
    play(env, 7)
    assert env.unwrapped.simulation.log == [7, 7, 7, 7]
    assert logs
    assert all(log == [4, 4, 4] for log in logs)


def test_errors_pass_through_environments_that_are_nested_deeply():
    def nested(depth):
        decide = decision(lambda: nested(depth - 1) if depth else 1 / 0, agent=f"deep_{depth}")
        run_inner(single_env(calling(decide), decide), RULE)

    outer = decision(lambda: nested(5), agent="outer_0")
    env = single_env(calling(outer, outer), outer)
    for _ in range(2):
        env.reset(seed=111)
        with pytest.raises(ZeroDivisionError) as caught:
            env.step(RULE)
        agents = [re.search(r"(deep|outer)_\d", note)[0] for note in caught.value.__notes__]
        assert agents == [*(f"deep_{depth}" for depth in range(6)), "outer_0"]
    env.reset()
    env.step(1)


def test_a_suspended_nest_is_collected():
    before, unwound, outer = stacks(), [], decision(agent="outer_0")

    class Nest(Script):
        def run(self):
            self.inner = single_env(unwinding(INNER, unwound), INNER)
            self.inner.reset()
            try:
                outer()
            finally:
                unwound.append("outer")

    env = single_env(lambda: Nest(None), outer)
    env.reset()
    del env
    assert stacks(before) == before
    assert sorted(unwound) == ["outer", "unwound"]


def test_environments_may_be_stepped_from_greenlets_of_the_user():
    decide = decision()
    env = single_env(calling(*[decide] * 6), decide)
    env.reset()
    for number in range(5):
        assert not greenlet.greenlet(env.step).switch(number)[2]
    main = greenlet.getcurrent()
    worker = greenlet.greenlet(lambda: main.switch(env.step(5)[2]))
    assert worker.switch()
    assert env.unwrapped.simulation.log == list(range(6))


# -- SimPy ----------------------------------------------------------------------------------------


class Shop:
    """Customers queue for a till; how long each is served is decided inside a process."""

    def __init__(self, env, log):
        self.env, self.till, self.log = env, simpy.Resource(env), log

    @define(agent="clerk_0", reward_mapping=lambda self, customer: self.env.now)
    def service_time(self, customer):
        return 1 + customer % 2

    @define(agent="manager_0")
    def pause(self):
        yield self.env.timeout(1)
        return "rested"

    def customer(self, number):
        yield self.env.timeout(number)
        with self.till.request() as request:
            yield request
            yield self.env.timeout(self.service_time(number))
        self.log.append((number, self.env.now))

    def manager(self):
        yield self.env.timeout(2)
        result = yield self.env.process(self.pause())
        self.log.append((result, self.env.now))
        self.log.append(((yield from self.pause()), self.env.now))


def shopping(simulation):
    env = simpy.Environment()
    shop = Shop(env, simulation.log)
    for number in range(4):
        env.process(shop.customer(number))
    env.process(shop.manager())
    env.run()


def test_decisions_inside_simpy_processes():
    env = aec_env(script(shopping), [Shop.service_time, Shop.pause])
    turns = play(env, RULE)
    assert env.unwrapped.simulation.log == plain_log(script(shopping))
    assert (decisions(turns).count("clerk_0"), decisions(turns).count("manager_0")) == (4, 2)
    turns = play(env, 3)
    # The pauses take no time, and return the action.
    assert env.unwrapped.simulation.log == [(3, 2), (3, 2), (0, 3), (1, 6), (2, 9), (3, 12)]
    assert rewards_of(turns, "clerk_0") == [3.0, 6.0, 9.0, 12.0]


@pytest.mark.parametrize("number", [1, 3, 30])
@pytest.mark.parametrize("how", ["close", "reset", "collect", "error"])
def test_simpy_models_unwind(how, number):
    before, unwound, decide = stacks(), [], decision(lambda: 1 / 0)

    def process(env, number):
        try:
            yield env.timeout(1)
            decide()
        finally:
            unwound.append(number)

    def main(simulation):
        env = simpy.Environment()
        env.run(env.all_of([env.process(process(env, n)) for n in range(number)]))

    gym = single_env(script(main), decide)
    gym.reset()
    if how == "error":
        for n in range(number - 1):  # SimPy keeps the error of a process until those that wait for it are told
            assert len(unwound) == n
            gym.step(RULE)
        with pytest.raises(ZeroDivisionError):
            gym.step(RULE)
    elif how != "collect":
        getattr(gym, how)()
        assert sorted(unwound) == list(range(number))
        gym.close()
    del gym
    gc.collect()
    assert set(unwound) == set(range(number))
    assert stacks(before) == before


# -- greenlets of the model ------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["end", "close", "collect"])
def test_greenlets_of_the_model_may_decide(how):
    use_greenlets_of_the_model(how)


@pytest.mark.greenlet("what the error's frames hold outlives the simulation's thread, where alone it could unwind")
def test_greenlets_of_the_model_unwind_when_the_error_that_holds_them_is_gone():
    use_greenlets_of_the_model("error")


def use_greenlets_of_the_model(how):
    before, unwound = stacks(), []
    decide = decision(lambda name: name, agent=lambda name: f"{name}_0")

    def worker(name):
        parent = greenlet.getcurrent().parent
        try:
            for _ in range(2):
                parent.switch(decide(name))
            if how == "error":
                raise ZeroDivisionError
        finally:
            unwound.append(name)

    def main(simulation):
        workers = {name: greenlet.greenlet(worker) for name in "ab"}
        for _ in range(3):
            for name, work in workers.items():
                simulation.log.append(work.switch(name))
            simulation.log.append(decide("m"))

    env = aec_env(script(main), decide)
    if how == "end":
        turns = play(env, lambda agent, env: len(env.unwrapped.simulation.log))
        assert decisions(turns) == ["a_0", "b_0", "m_0"] * 2 + ["m_0"]
        assert env.unwrapped.simulation.log == [0, 1, 2, 3, 4, 5, None, None, 8]
    else:
        env.reset()
        for number in range(5 if how == "error" else 4):
            env.step(number)
        if how == "error":
            with pytest.raises(ZeroDivisionError):
                env.step(5)
        if how == "close":
            env.close()
    del env
    assert stacks(before) == before
    assert sorted(unwound) == ["a", "b"]


# -- asyncio --------------------------------------------------------------------------------------


class Office:
    """Clerks work concurrently on one event loop; each decides how many rounds a task takes."""

    @define(agent="clerk_0")
    async def rounds(self, number):
        await asyncio.sleep(0)
        return number % 3

    @define(agent="boss_0")
    def bonus(self, number):
        return 1

    async def clerk(self, number, log):
        rounds = await self.rounds(number)
        for _ in range(rounds):
            await asyncio.sleep(0)
        log.append((number, rounds, self.bonus(number)))

    async def work(self, number, log):
        await asyncio.gather(*[self.clerk(n, log) for n in range(number)])


@pytest.fixture
def _no_loop_stays_behind(caplog):
    # asyncio logs, whenever it is collected, each task whose exception nobody has asked for.
    with caplog.at_level(logging.CRITICAL, logger="asyncio"):
        yield
        asyncio._set_running_loop(None)  # a failed test is no reason for others to fail
        gc.collect()


def office():
    return script(lambda simulation: asyncio.run(Office().work(4, simulation.log)))


@pytest.mark.usefixtures("_no_loop_stays_behind")
def test_decisions_inside_coroutines():
    env = aec_env(office(), [Office.rounds, Office.bonus])
    turns = play(env, {"clerk_0": iter([3, 2, 1, 0]), "boss_0": 7})
    assert env.unwrapped.simulation.log == [(3, 0, 7), (2, 1, 7), (1, 2, 7), (0, 3, 7)]
    assert sorted(decisions(turns)) == ["boss_0"] * 4 + ["clerk_0"] * 4


@pytest.mark.usefixtures("_no_loop_stays_behind")
@VIEWS
def test_models_that_use_asyncio_run_side_by_side(view):
    policies = {Office.bonus: RULE} if view is single_env else None
    envs = [view(office(), [Office.rounds, Office.bonus], policies=policies) for _ in range(3)]
    for env in envs:
        env.reset()
    running = list(envs)
    while running:
        for env in list(running):
            result = env.step(RULE)
            if result[2] if view is single_env else any(env.terminations.values()):
                running.remove(env)
    assert [env.unwrapped.simulation.log for env in envs] == [plain_log(office())] * 3


@pytest.mark.usefixtures("_no_loop_stays_behind")
def test_models_may_be_the_first_to_import_asyncio():
    code = """
        import sys
        from tests.worlds.models import decision, script
        from simenv_marl import single_env
        assert "asyncio" not in sys.modules
        decide = decision()
        def main(simulation):
            import asyncio
            async def work():
                for _ in range(2):
                    await asyncio.sleep(0)
                    simulation.log.append(decide())
            asyncio.run(work())
        env = single_env(script(main), decide)
        env.reset()
        import asyncio
        async def use():
            return asyncio.get_running_loop().is_running()
        for action in (1, 2):
            assert asyncio.run(use())
            env.step(action)
        print(env.unwrapped.simulation.log)
    """
    result = subprocess.run([sys.executable, "-c", dedent(code)], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "[1, 2]\n"), result.stderr


# -- state of the interpreter ---------------------------------------------------------------------


def test_decimal_contexts_and_handled_errors_do_not_leak():
    def main(simulation):
        with decimal.localcontext() as context:
            context.prec = 3
            try:
                raise KeyError("the model's")
            except KeyError:
                decide()
                simulation.log += [decimal.Decimal(1) / 3, sys.exc_info()[0]]
                decide()

    decide = decision()
    env = single_env(script(main), decide)
    env.reset()
    assert decimal.getcontext().prec == 28
    assert sys.exc_info() == (None, None, None)
    try:
        raise ValueError("the user's")
    except ValueError:
        env.step(1)
        assert sys.exc_info()[0] is ValueError
    assert env.unwrapped.simulation.log == [decimal.Decimal("0.333"), KeyError]
    assert decimal.getcontext().prec == 28
    env.close()


@pytest.mark.usefixtures("_collected")
def test_models_may_recurse_as_deeply_as_without_an_environment():
    decide = decision()

    def dive(depth):
        return decide() if depth == 0 else dive(depth - 1)

    depth = sys.getrecursionlimit() - 200
    env = single_env(calling(*[lambda: dive(depth)] * 2), decide)
    env.reset()
    env.step(1)
    env.step(2)
    assert env.unwrapped.simulation.log == [1, 2]
