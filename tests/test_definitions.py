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
from tests.worlds.models import calling, decision, decisions, define, plainly, play, script


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


class BigPump(Pump):
    power = 30


def test_decision_function_outside_an_env_calls_the_models_rule():
    pump = Pump()
    assert (
        pump.flow(1.5, unit="m", fast=True)
        == Pump.flow(pump, 1.5, "m", fast=True)
        == (1.5, "m", True)
    )
    assert Pump.flow.__wrapped__(pump, 4) == (4, "l", False)
    for held, kind in (
        ("rounded", staticmethod),
        ("halved", staticmethod),
        ("strongest", classmethod),
    ):
        assert type(vars(Pump)[held]) is kind
    assert Pump.rounded(2.5) == Pump().rounded(2.5) == 2
    assert Pump.halved(3) == BigPump().halved(3) == 1.5
    assert (Pump.strongest(), BigPump.strongest(factor=2), BigPump().strongest()) == (3, 60, 30)
    assert (Pump.weakest(), BigPump().weakest()) == (-3, -30)


def test_decision_function_keeps_its_metadata_and_is_pickled_by_name():
    assert (Pump.flow.__name__, Pump.flow.__qualname__, Pump.flow.__module__) == (
        "flow",
        "Pump.flow",
        __name__,
    )
    assert (Pump.flow.__doc__, Pump.strongest.__doc__) == ("How much flows.", "The power.")
    signature = (
        "amount: float, /, unit: str = 'l', *, fast: bool = False) -> tuple[typing.Any, ...]"
    )
    assert str(inspect.signature(Pump.flow)) == f"(self, {signature}"
    assert str(inspect.signature(Pump().flow)) == f"({signature}"
    assert inspect.isfunction(Pump.flow)
    assert inspect.ismethod(Pump().flow)
    assert typing.get_type_hints(Pump.rounded) == {"amount": float, "return": int}
    for function in (Pump.flow, Pump.rounded, Pump.strongest):
        assert pickle.loads(pickle.dumps(function)) == function


def test_rule_and_truncated_constants_survive_pickling():
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
        (
            {"action_space": spaces.Discrete(3), "action_space_mapping": {0: 1, 1: 2}},
            "must have just the actions",
        ),
        (
            {"action_space": spaces.Discrete(2), "action_space_mapping": {0: 1, 1: 2, 2: 3}},
            "just the actions",
        ),
        ({"action_space": spaces.Box(0, 1), "action_space_mapping": {0: 1}}, "needs a Discrete"),
        ({"apply": print, "action_space_mapping": print}, "give one of"),
        ({"choices": list, "action_space_mapping": print}, "give one of"),
        ({"choices": list, "action_space": spaces.Box(0, 1)}, "choices needs a Discrete"),
        ({"choices": list, "action_space": spaces.Discrete(3, start=1)}, "starts at 0"),
        ({"choices": list, "action_mask_mapping": list}, "leave action_mask_mapping out"),
        (
            {"action_mask_mapping": list, "action_space": spaces.Box(0, 1)},
            "needs a Discrete or MultiDiscrete",
        ),
        ({"rule_action_mapping": 3}, "rule_action_mapping must be a callable or a dict"),
        ({"agent": ""}, "agent must be a text"),
        ({"removed_by": {3: None}}, "removed_by must be a dict from dotted names"),
        (
            {"removed_by": {"package.function": "ant_0"}},
            "removed_by must be a dict from dotted names",
        ),
        ({"goal_space": spaces.Discrete(3)}, "a goal needs all of its parts"),
        (GOAL, "missing: goal_space"),
    ],
    ids=plainly,
)
def test_make_step_refuses_definitions_that_cannot_work(changes, match):
    """Also where they are made of others by replacing parts."""
    with pytest.raises(DefinitionError, match=f"make_step: .*{match}"):
        define(**changes)
    spared = {"action_space_mapping": None} if changes.keys() & {"apply", "choices"} else {}
    with pytest.raises(DefinitionError, match=match):
        dataclasses.replace(define(), **spared | changes)


def test_definition_can_be_changed_with_dataclasses_replace():
    definition = define(
        action_space=spaces.Discrete(2),
        action_space_mapping={0: "no", 1: "yes"},
        removed_by="package.module.function",
    )
    same = dataclasses.replace(definition, agent="ant_0")
    assert same.action_space_mapping(1) == "yes"
    assert same.removed_by == {"package.module.function": None}
    answers, removed_by = {0: "no", 1: "yes", 2: "maybe"}, {"package.module.other": None}
    more = {
        "action_space": spaces.Discrete(3),
        "action_space_mapping": answers,
        "removed_by": removed_by,
    }
    other = dataclasses.replace(definition, **more)
    answers.clear()
    removed_by.clear()
    assert other.action_space_mapping(2) == "maybe"
    assert other.removed_by == {"package.module.other": None}
    with pytest.raises(DefinitionError, match="must have just the actions"):
        dataclasses.replace(definition, action_space=spaces.Discrete(3))


async def flow():
    yield 1


@pytest.mark.parametrize(
    "function",
    [len, property(lambda self: 1), functools.partial(int), int, None, Pump().flow, flow],
    ids=plainly,
)
def test_make_step_refuses_objects_that_are_no_functions(function):
    with pytest.raises(
        PatchError, match="is an async generator function" if function is flow else None
    ):
        define()(function)


@pytest.mark.parametrize(
    ("name", "call", "args", "kwargs"),
    [
        ("rounded", lambda pump: type(pump).rounded(amount=1), (1,), {}),
        ("halved", lambda pump: pump.halved(1), (1,), {}),
        ("strongest", lambda pump: type(pump).strongest(), ("class",), {"factor": 1}),
        ("weakest", lambda pump: pump.weakest(), ("class",), {}),
    ],
)
def test_static_and_class_methods_pass_bound_arguments_to_mappings(name, call, args, kwargs):
    seen = []

    def observe(*args, **kwargs):
        seen.append((args, kwargs))
        return [0, 0]

    class Copy(Pump):
        pass

    setattr(Copy, name, define(observation_space_mapping=observe)(vars(Pump)[name]))
    aec_env(calling(lambda: call(Copy())), getattr(Copy, name)).reset()
    assert seen == [(tuple(Copy if value == "class" else value for value in args), kwargs)]


def told_by(env, *actions):
    """What the model is told where its decisions are answered so."""
    env.reset()
    for action in actions:
        env.step(action)
    return env.simulation.log


@pytest.mark.parametrize(
    ("space", "answers", "refused"),
    [
        (spaces.Discrete(3), {0: "a", 1: None, 2: RuntimeError}, [3, "a"]),
        (spaces.Discrete(2, start=-1), {-1: "down", 0: "stay"}, [1]),
    ],
    ids=["from 0", "from -1"],
)
def test_action_space_mapping_can_be_a_dict_of_decisions(space, answers, refused):
    decide = decision(action_space=space, action_space_mapping=answers)
    env = single_env(calling(*[decide] * len(answers)), decide)
    env.reset()
    for action in refused:
        with pytest.raises(InvalidActionError, match="is not in its action space"):
            env.step(action)
    assert env.simulation.log == []  # nothing has moved
    assert told_by(env, *map(np.int64, answers)) == list(answers.values())


def test_apply_runs_in_the_simulation_instead_of_the_models_rule():
    factor = decision(agent="factor_0")
    decide = decision(apply=lambda action: action * factor(), agent="decider_0")
    env = aec_env(calling(decide, decide), [decide, factor])
    turns = play(env, iter([5, 2, 3, 4]))
    # The decision that apply calls is one like any other.
    assert decisions(turns) == ["decider_0", "factor_0"] * 2
    assert env.simulation.log == [10, 12]


# -- functions that wait --------------------------------------------------------------------------


def haggle(good):
    answer = yield good
    return answer + 1


async def order(good):
    return "rule", good


def apply_plainly(action, good):
    return action, good


def apply_in_steps(action, good):
    answer = yield good
    return action, answer


async def apply_later(action, good):
    return action, good


def finished(made):
    """The yields of a generator or coroutine, each answered by 100, and its return value."""
    yields = []
    try:
        yields.append(made.send(None))
        while True:
            yields.append(made.send(100))
    except StopIteration as stop:
        return yields, stop.value


@pytest.mark.parametrize(
    ("function", "apply", "told", "rule"),
    [
        (haggle, None, ([], 5), (["tea"], 101)),
        (haggle, apply_plainly, ([], (5, "tea")), (["tea"], 101)),
        (haggle, apply_in_steps, (["tea"], (5, 100)), (["tea"], 101)),
        (order, None, ([], 5), ([], ("rule", "tea"))),
        (order, apply_later, ([], (5, "tea")), ([], ("rule", "tea"))),
    ],
)
def test_generator_or_coroutine_decision_is_asked_for_when_it_starts(function, apply, told, rule):
    changes = {"apply": apply} if apply else {}
    decide = define(observation_space_mapping=lambda good: [len(started), 0], **changes)(function)
    started = []

    def main(simulation):
        for _ in range(2):
            made = decide("tea")
            started.append(made)
            simulation.log.append(finished(made))

    env = single_env(script(main), decide)
    assert env.reset()[0].tolist() == [1, 0]
    env.step(5)
    env.step(RULE)
    assert env.simulation.log == [told, rule]


def test_decision_function_can_have_several_definitions():
    early = decision(action_space_mapping=lambda action: "early")
    late = define(action_space_mapping=lambda action: "late")(early)
    last = define(action_space_mapping=lambda action: "last")(late)
    assert early.__wrapped__ is late.__wrapped__ is last.__wrapped__
    for called in (early, late, last):
        told = [told_by(single_env(calling(called), named), 1) for named in (early, late, last)]
        assert told == [["early"], ["late"], ["last"]]


def test_choices_function_is_called_once_per_decision_and_gives_the_mask():
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
    assert env.simulation.log == [("board", "left", 2)]


@pytest.mark.parametrize("choices", [list, lambda: range(5)])
def test_choices_that_are_empty_or_too_many_raise_an_error(choices):
    decide = decision(action_space=spaces.Discrete(4), choices=choices)
    with pytest.raises(MaskError, match="choices"):
        single_env(calling(decide), decide).reset()


def named(name, **changes):
    """A decision function of that name."""

    def rule():
        return 0

    rule.__qualname__ = name
    return decision(rule, **changes)


WATER, GO, ALSO_GO, GIVEN = (
    named("Choose_water_2"),
    named("go"),
    named("go"),
    named("going", agent="go_0"),
)


@pytest.mark.parametrize(
    ("points", "names"),
    [
        ([WATER, GO, ALSO_GO], ["choosewater_0", "go_0", "go_1"]),
        ([ALSO_GO, GO], ["go_0", "go_1"]),
        ([GO, GIVEN], ["go_1", "go_0"]),
    ],
)
def test_default_agent_names_come_from_function_names_and_are_unique(points, names):
    env = aec_env(calling(GO), points)
    assert env.possible_agents == names
    env.reset()
    assert env.agent_selection == names[points.index(GO)]


def test_difference_reward_is_zero_at_first_and_outside_episodes():
    count, used = [0], np.array(0.0)  # which changes in place
    change = difference(lambda: used)

    def main(simulation):
        for step in (3, 5):
            decide()
            count[0] += step
            np.add(used, step, out=used)

    decide = decision(
        observation_space=spaces.Box(-100, 100, (), np.float32),
        observation_space_mapping=difference(lambda: count[0]),
        reward_mapping=lambda: 2 * change(),
    )
    env = single_env(script(main), decide)
    for _ in range(2):
        assert env.reset()[0] == 0
        assert [env.step(0)[:2] for _ in range(2)] == [(3, 6.0), (5, 10.0)]
    outside = difference(iter(range(10)).__next__)
    assert [outside(), outside()] == [0.0, 0.0]


def test_difference_refuses_arguments_that_are_not_callable():
    with pytest.raises(DefinitionError):
        difference(3)
