"""Section 3: make_step, and what it makes of a function."""

import dataclasses
import functools
import inspect
import pickle
import typing
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, TRUNCATED, aec_env, difference, single_env
from simenv_marl.errors import DefinitionError, InvalidActionError, MaskError, PatchError
from tests.worlds.models import calling, decision, decisions, define, plainly, play, rewards_of, script


class Pump:
    """Its functions are of every kind, decorated in both orders where there are two."""

    power = 3

    @define()
    def flow(self, amount: float, /, unit: str = "l", *, fast: bool = False) -> tuple[Any, ...]:
        """How much flows."""
        return amount, unit, fast

    @define()
    @staticmethod
    def rounded(amount: float) -> int:
        return int(amount)

    @staticmethod
    @define()
    def halved(amount: float) -> float:
        return amount / 2

    @define()
    @classmethod
    def strongest(cls, *, factor: int = 1) -> int:
        """The power."""
        return cls.power * factor

    @classmethod
    @define()
    def weakest(cls) -> int:
        return -cls.power

    @define()
    @staticmethod
    def named(*, amount: int = 1) -> int:
        return amount

    @define()
    def anything(self, *args: int, **kwargs: int) -> Any:
        return args, kwargs


class BigPump(Pump):
    power = 30


def test_outside_any_environment_a_decision_function_is_the_rule_and_keeps_its_binding():
    pump = Pump()
    assert pump.flow(1.5, unit="m", fast=True) == Pump.flow(pump, 1.5, "m", fast=True) == (1.5, "m", True)
    assert pump.anything(1, 2, amount=3) == ((1, 2), {"amount": 3})
    assert Pump.flow.__wrapped__(pump, 4) == (4, "l", False)
    for held, kind in (("rounded", staticmethod), ("halved", staticmethod), ("strongest", classmethod)):
        assert type(vars(Pump)[held]) is kind
    assert Pump.rounded(2.5) == Pump().rounded(2.5) == 2
    assert Pump.halved(3) == BigPump().halved(3) == 1.5
    assert (Pump.strongest(), BigPump.strongest(factor=2), BigPump().strongest()) == (3, 60, 30)
    assert (Pump.weakest(), BigPump().weakest()) == (-3, -30)


def test_a_decision_function_keeps_its_looks():
    assert (Pump.flow.__name__, Pump.flow.__qualname__, Pump.flow.__module__) == ("flow", "Pump.flow", __name__)
    assert (Pump.flow.__doc__, Pump.strongest.__doc__) == ("How much flows.", "The power.")
    signature = "amount: float, /, unit: str = 'l', *, fast: bool = False) -> tuple[typing.Any, ...]"
    assert str(inspect.signature(Pump.flow)) == f"(self, {signature}"
    assert str(inspect.signature(Pump().flow)) == f"({signature}"
    assert inspect.isfunction(Pump.flow)
    assert inspect.ismethod(Pump().flow)
    assert typing.get_type_hints(Pump.rounded) == {"amount": float, "return": int}


def test_decision_functions_are_pickled_by_name():
    for function in (Pump.flow, Pump.rounded, Pump.strongest):
        assert pickle.loads(pickle.dumps(function)) == function


def test_sentinels_stay_themselves():
    for sentinel in (RULE, TRUNCATED):
        assert pickle.loads(pickle.dumps(sentinel)) is sentinel
        assert repr(sentinel).startswith("simenv_marl.")


GOAL = {"achieved_goal_mapping": list, "desired_goal_mapping": list, "compute_reward": abs}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"observation_space": 3}, "observation_space must be a gymnasium space"),
        ({"reward_mapping": None}, "reward_mapping must be callable"),
        ({"action_space_mapping": None}, "give one of action_space_mapping, apply and choices"),
        ({"action_space_mapping": [1, 2]}, "action_space_mapping must be a callable or a dict"),
        ({"action_space": spaces.Discrete(3), "action_space_mapping": {0: 1, 1: 2}}, "must have just the actions"),
        ({"action_space": spaces.Discrete(2), "action_space_mapping": {0: 1, 1: 2, 2: 3}}, "just the actions"),
        ({"action_space": spaces.Discrete(2, start=1), "action_space_mapping": {0: 1, 1: 2}}, "just the actions"),
        ({"action_space": spaces.Box(0, 1), "action_space_mapping": {0: 1}}, "needs a Discrete"),
        ({"apply": print, "action_space_mapping": print}, "give one of"),
        ({"choices": list, "action_space_mapping": print}, "give one of"),
        ({"choices": list, "action_space": spaces.Box(0, 1)}, "choices needs a Discrete"),
        ({"choices": list, "action_space": spaces.Discrete(3, start=1)}, "starts at 0"),
        ({"choices": list, "action_mask_mapping": list}, "leave action_mask_mapping out"),
        ({"action_mask_mapping": list, "action_space": spaces.Box(0, 1)}, "needs a Discrete or MultiDiscrete"),
        ({"rule_action_mapping": 3}, "rule_action_mapping must be a callable or a dict"),
        ({"agent": ""}, "agent must be a name"),
        ({"removed_by": {3: None}}, "removed_by must be a dict from dotted names"),
        ({"goal_space": spaces.Discrete(3)}, "a goal needs all of its parts"),
        (GOAL, "missing: goal_space"),
    ],
    ids=plainly,
)
def test_definitions_that_cannot_work_are_refused(changes, match):
    """Also where they are made of others by replacing parts."""
    with pytest.raises(DefinitionError, match=f"make_step: .*{match}") as caught:
        define(**changes)
    assert isinstance(caught.value, ValueError)
    spared = {"action_space_mapping": None} if changes.keys() & {"apply", "choices"} else {}
    with pytest.raises(DefinitionError, match=match):
        dataclasses.replace(define(), **spared | changes)


def test_a_definition_that_is_replaced_in_part_is_made_ready_as_a_whole():
    definition = define(
        action_space=spaces.Discrete(2), action_space_mapping={0: "no", 1: "yes"}, removed_by="package.module.function"
    )
    same = dataclasses.replace(definition, agent="ant_0")
    assert same.action_space_mapping(1) == "yes"
    assert same.removed_by == {"package.module.function": None}
    answers, removed_by = {0: "no", 1: "yes", 2: "maybe"}, {"package.module.other": None}
    more = {"action_space": spaces.Discrete(3), "action_space_mapping": answers, "removed_by": removed_by}
    other = dataclasses.replace(definition, **more)
    answers.clear(), removed_by.clear()
    assert other.action_space_mapping(2) == "maybe"
    assert other.removed_by == {"package.module.other": None}
    with pytest.raises(DefinitionError, match="must have just the actions"):
        dataclasses.replace(definition, action_space=spaces.Discrete(3))


async def flow():
    yield 1


@pytest.mark.parametrize(
    "function", [len, property(lambda self: 1), functools.partial(int), int, None, Pump().flow, flow], ids=plainly
)
def test_only_functions_can_be_decided(function):
    with pytest.raises(PatchError, match="is an async generator function" if function is flow else None):
        define()(function)


@pytest.mark.parametrize(
    ("name", "call", "args", "kwargs"),
    [
        ("flow", lambda pump: pump.flow(1, fast=True, unit=None), ("self", 1, None), {"fast": True}),
        ("rounded", lambda pump: pump.rounded(1), (1,), {}),
        ("rounded", lambda pump: type(pump).rounded(amount=1), (1,), {}),
        ("halved", lambda pump: pump.halved(1), (1,), {}),
        ("strongest", lambda pump: type(pump).strongest(), ("class",), {"factor": 1}),
        ("strongest", lambda pump: pump.strongest(factor=2), ("class",), {"factor": 2}),
        ("anything", lambda pump: pump.anything(1, 2, x=3), ("self", 1, 2), {"x": 3}),
        ("named", lambda pump: pump.named(amount=2), (), {"amount": 2}),
    ],
)
def test_mappings_receive_the_arguments_bound_to_the_signature(name, call, args, kwargs):
    seen = []

    def observe(*args, **kwargs):
        seen.append((args, kwargs))
        return [0, 0]

    class Copy(Pump):
        pass

    copy = Copy()
    setattr(Copy, name, define(observation_space_mapping=observe)(vars(Pump)[name]))
    aec_env(calling(lambda: call(copy)), getattr(Copy, name)).reset()
    named = {"self": copy, "class": Copy}
    assert seen == [(tuple(named.get(value, value) for value in args), kwargs)]


def told_by(env, *actions):
    """What the model is told where its decisions are answered so."""
    env.reset()
    for action in actions:
        env.step(action)
    return env.unwrapped.simulation.log


@pytest.mark.parametrize(
    ("changes", "refused", "actions", "told"),
    [
        (
            {"action_space": spaces.Discrete(3), "action_space_mapping": {0: "a", 1: None, 2: RuntimeError}},
            [3, "a"],
            [2, 1, 0],
            [RuntimeError, None, "a"],
        ),
        (
            {"action_space": spaces.Discrete(2, start=-1), "action_space_mapping": {-1: "down", 0: "stay"}},
            [1],
            [np.int64(-1), 0],
            ["down", "stay"],
        ),
        ({"action_space_mapping": lambda action: None}, [10], [1], [None]),
        ({"action_mask_mapping": lambda: [0, 1, 1], "action_space": spaces.Discrete(3)}, [0], [1, RULE], [1, "rule"]),
        ({"action_mask_mapping": lambda: [0, 1], "action_space": spaces.Discrete(2, start=5)}, [5], [6], [6]),
        ({"choices": lambda: "ab", "action_space": spaces.Discrete(3)}, [2], [1, np.int64(0)], ["b", "a"]),
    ],
    ids=["dict", "start", "none", "mask", "mask from 5", "choices"],
)
def test_actions_decide_by_their_mapping_and_illegal_ones_are_refused(changes, refused, actions, told):
    decide = decision(**changes)
    env = single_env(calling(*[decide] * len(actions)), decide)
    env.reset()
    masked = "choices" in changes or "action_mask_mapping" in changes
    for action in refused:
        with pytest.raises(InvalidActionError, match="is masked" if masked else "is not in its action space"):
            env.step(action)
        assert env.unwrapped.simulation.log == []  # nothing has moved
    for action in actions:
        env.step(action)
    assert env.unwrapped.simulation.log == told


def test_changing_the_dict_afterwards_changes_nothing():
    answers = {0: "a", 1: "b"}
    decide = decision(action_space=spaces.Discrete(2), action_space_mapping=answers)
    answers[0] = "changed"
    assert told_by(single_env(calling(decide), decide), 0) == ["a"]


def test_apply_runs_in_the_simulation_in_place_of_the_rule():
    ran = []

    class Model:
        level = 0

        @define(apply=lambda action, self: self.change(action))
        def decide(self):
            ran.append("rule")

        def change(self, by):
            self.level += by * self.factor()

        @define()
        def factor(self):
            return 1

    model = Model()
    env = aec_env(calling(model.decide, model.decide), [Model.decide, Model.factor])
    turns = play(env, iter([5, 2, 3, 4]))
    # The decision that apply calls is one like any other.
    assert decisions(turns) == ["decide_0", "factor_0", "decide_0", "factor_0"]
    assert model.level == 5 * 2 + 3 * 4
    assert not ran


def exhaust(generator):
    """Run a generator as ``yield from`` does, answering 100 to each yield; return yields and value."""
    yields = []
    try:
        value = next(generator)
        while True:
            yields.append(value)
            value = generator.send(100)
    except StopIteration as stop:
        return yields, stop.value


def test_a_generator_functions_value_is_the_decision_when_it_starts():
    level = [0]

    def haggle(good):
        answer = yield good
        return answer + 1

    haggle = define(observation_space_mapping=lambda good: [level[0], 0])(haggle)

    def main(simulation):
        for _ in range(2):
            generator = haggle("tea")
            level[0] += 1
            simulation.log.append(exhaust(generator))

    env = single_env(script(main), haggle)
    assert env.reset()[0].tolist() == [1, 0]
    env.step(7)
    env.step(RULE)
    assert env.unwrapped.simulation.log == [([], 7), (["tea"], 101)]


def test_apply_of_a_generator_function_may_be_one_too():
    def haggle(good):
        yield "rule"

    def plain(action, good):
        return action, good

    def stepwise(action, good):
        answer = yield good
        return action, answer

    for apply, expected in ((plain, ([], (5, "tea"))), (stepwise, (["tea"], (5, 100)))):
        decide = define(apply=apply)(haggle)
        env = single_env(calling(lambda decide=decide: exhaust(decide("tea"))), decide)
        assert told_by(env, 5) == [expected]


def test_a_coroutines_value_is_the_decision():
    async def later(good):
        return "rule", good

    async def applied(action, good):
        return action, good

    def run(coroutine):
        with pytest.raises(StopIteration) as stop:
            coroutine.send(None)
        return stop.value.value

    for definition, expected in ((define(), 5), (define(apply=applied), (5, "tea"))):
        decide = definition(later)
        env = single_env(calling(*[lambda decide=decide: run(decide("tea"))] * 2), decide)
        assert told_by(env, 5, RULE) == [expected, ("rule", "tea")]


def test_one_function_may_have_many_definitions():
    early = decision(action_space_mapping=lambda action: "early")
    late = define(action_space_mapping=lambda action: "late")(early)
    last = define(action_space_mapping=lambda action: "last")(late)
    assert early.__wrapped__ is late.__wrapped__ is last.__wrapped__
    for called in (early, late, last):
        told = [told_by(single_env(calling(called), named), 1) for named in (early, late, last)]
        assert told == [["early"], ["late"], ["last"]]


def test_masks_of_multi_discrete_spaces_have_a_part_for_each():
    decide = decision(action_space=spaces.MultiDiscrete([2, 3]), action_mask_mapping=lambda: ([1, 0], [0, 1, 1]))
    env = single_env(calling(decide), decide)
    _, info = env.reset()
    assert [part.tolist() for part in info["action_mask"]] == [[1, 0], [0, 1, 1]]
    assert all(part.dtype == np.int8 for part in info["action_mask"])
    for illegal in ([1, 1], [0, 0]):
        with pytest.raises(InvalidActionError, match="is masked"):
            env.step(np.array(illegal))
    env.action_space.seed(0)
    env.step(env.action_space.sample(info["action_mask"]))
    assert env.unwrapped.simulation.log[0][0] == 0


def test_choices_are_asked_once_with_the_arguments_and_make_the_mask():
    made = []

    def move(board, *, side):
        return "rule"

    def moves(board, *, side):
        made.append([(board, side, number) for number in range(3 - len(made))])
        return iter(made[-1])

    move = define(action_space=spaces.Discrete(4), choices=moves)(move)
    env = single_env(calling(*[lambda: move("board", side="left")] * 2), move)
    _, info = env.reset()
    assert info["action_mask"].tolist() == [1, 1, 1, 0]
    assert info["action_mask"].dtype == np.int8
    assert env.step(2)[4]["action_mask"].tolist() == [1, 1, 0, 0]
    assert len(made) == 2
    assert env.unwrapped.simulation.log == [("board", "left", 2)]


@pytest.mark.parametrize("choices", [list, lambda: range(5)])
def test_no_choices_and_too_many_are_errors(choices):
    decide = decision(action_space=spaces.Discrete(4), choices=choices)
    with pytest.raises(MaskError, match="choices"):
        single_env(calling(decide), decide).reset()


class Left:
    @define()
    def Choose_water_2(self):  # noqa: N802
        return 0

    @define()
    def go(self):
        return 0


class Right:
    @define()
    def go(self):
        return 0

    @define(agent="go_0")
    def given(self):
        return 0


@pytest.mark.parametrize(
    ("points", "names"),
    [
        ([Left.Choose_water_2, Left.go, Right.go], ["choosewater_0", "go_0", "go_1"]),
        ([Right.go, Left.go], ["go_0", "go_1"]),
        ([Left.go, Right.given], ["go_1", "go_0"]),
    ],
)
def test_default_names_are_the_functions_letters_in_the_order_of_points_and_collide_with_none(points, names):
    env = aec_env(calling(Left().go), points)
    assert env.possible_agents == names
    env.reset()
    assert env.agent_selection == names[points.index(Left.go)]


def test_agents_that_a_callable_names_which_is_asked_once_at_each_decision():
    asked = []

    def decide(name):
        return "rule"

    decide = define(agent=lambda name: asked.append(name) or name)(decide)
    names = ["a", "b", None, "a", "c"]
    env = aec_env(calling(*[lambda name=name: decide(name) for name in names]), decide)
    assert not hasattr(env, "possible_agents")
    env.reset()
    assert env.agents == asked == ["a"]
    assert decisions(play(env, 1, reset=False)) == ["a", "b", "a", "c"]
    assert env.unwrapped.simulation.log == [1, 1, "rule", 1, 1]
    assert asked == names


class Meter:
    """Counts; two agents read it."""

    count = 100

    @define(agent="reader_0", reward_mapping=difference(lambda self: self.count))
    def read(self):
        return 0

    @define(agent="watcher_0", reward_mapping=lambda self: 2 * USED(self))
    def watch(self):
        return 0


USED = difference(lambda self: float(self.count))


def metering(simulation):
    meter = Meter()
    for step in (1, 10, 100):
        meter.read()
        meter.count += step
        meter.watch()
        meter.count += step


def test_differences_count_for_each_agent_since_it_was_last_asked():
    env = aec_env(script(metering), [Meter.read, Meter.watch])
    for _ in range(2):  # each episode counts anew
        turns = play(env)
        assert rewards_of(turns, "reader_0") == [2.0, 20.0, 200.0]
        assert rewards_of(turns, "watcher_0") == [2 * 11.0, 2 * 110.0, 2 * 100.0]


def test_differences_of_two_environments_do_not_mix():
    first, second = (aec_env(script(metering), [Meter.read, Meter.watch]) for _ in range(2))
    first.reset()
    second.reset()
    seen = {first: [], second: []}
    for env in [first, second, second, first, first, first, second, second] * 3:
        if env.agents:
            _, reward, terminated, *_ = env.last()
            seen[env].append((env.agent_selection, reward))
            env.step(None if terminated else RULE)
    expected = [(turn.agent, turn.reward) for turn in play(aec_env(script(metering), [Meter.read, Meter.watch]))]
    assert seen[first] == seen[second] == expected


def test_differences_are_zero_the_first_time_and_of_numbers_that_change_in_place():
    count, used = [0], np.array(0.0)

    def main(simulation):
        for step in (3, 5):
            decide()
            count[0] += step
            np.add(used, 2 * step, out=used)

    decide = decision(
        observation_space=spaces.Box(-100, 100, (), np.float32),
        observation_space_mapping=difference(lambda: count[0]),
        reward_mapping=difference(lambda: used),
    )
    env = single_env(script(main), decide)
    for _ in range(2):
        assert env.reset()[0] == 0
        assert [env.step(0)[:2] for _ in range(2)] == [(3, 6.0), (5, 10.0)]


def test_differences_outside_any_environment_are_zero():
    change = difference(iter(range(10)).__next__)
    assert [change(), change()] == [0.0, 0.0]


def test_difference_needs_a_callable():
    with pytest.raises(DefinitionError):
        difference(3)
