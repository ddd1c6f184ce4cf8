"""Section 3: make_step, and what it makes of a function."""

import dataclasses
import functools
import inspect
import math
import pickle
import typing
from abc import ABC, abstractmethod
from typing import Any

import cloudpickle
import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, TRUNCATED, Definition, aec_env, difference, make_step, single_env
from simenv_marl.errors import DefinitionError, InvalidActionError, MaskError, PatchError
from tests.worlds.models import Script, calling, decision, decisions, define, plainly, play, rewards_of, script


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


def test_outside_any_environment_a_decision_function_is_the_rule():
    pump = Pump()
    assert pump.flow(1.5) == (1.5, "l", False)
    assert pump.flow(1.5, unit="m", fast=True) == (1.5, "m", True)
    assert Pump.flow(pump, 2, "m") == (2, "m", False)
    assert pump.anything(1, 2, amount=3) == ((1, 2), {"amount": 3})
    assert pump.anything() == ((), {})
    assert Pump.flow.__wrapped__(pump, 4) == (4, "l", False)


def test_statics_and_class_methods_keep_their_binding():
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


def test_an_abstract_decision_stays_abstract():
    class Model(ABC):
        @define()
        @abstractmethod
        def decide(self):
            """To be overridden."""

    class Concrete(Model):
        @define(agent="concrete_0")
        def decide(self):
            return super().decide() or "rule"

    with pytest.raises(TypeError):
        Model()
    assert Concrete().decide() == "rule"
    # What is overridden is another decision, which the one that overrides it may call.
    env = aec_env(calling(lambda: Concrete().decide()), [Model.decide, Concrete.decide])
    assert decisions(play(env, {"concrete_0": RULE, "decide_0": 3})) == ["concrete_0", "decide_0"]
    assert env.unwrapped.simulation.log == [3]


def test_decision_functions_are_pickled_by_name():
    for function in (Pump.flow, Pump.rounded, Pump.strongest, Twice.decide):
        assert pickle.loads(pickle.dumps(function)) == function


@pytest.mark.parametrize(
    "call",
    [
        lambda pump: pump.flow(),
        lambda pump: pump.flow(1, 2, 3),
        lambda pump: pump.flow(amount=1),
        lambda pump: pump.flow(1, speed=2),
        lambda pump: Pump.flow(),
        lambda pump: Pump.rounded(),
        lambda pump: Pump.strongest(2),
    ],
)
def test_wrong_calls_are_type_errors_and_no_decisions(call):
    pump = Pump()

    def main(simulation):
        with pytest.raises(TypeError):
            call(pump)
        pump.halved(3)

    main(None)
    env = aec_env(script(main), [Pump.flow, Pump.rounded, Pump.strongest, Pump.halved])
    env.reset()
    assert env.agent_selection == "halved_0"


def test_generators_and_coroutines_stay_what_they_are():
    def steps():
        yield 1
        return 2

    async def later():
        return 3

    assert inspect.isgeneratorfunction(decision(steps))
    assert list(decision(steps)()) == [1]
    assert inspect.iscoroutinefunction(decision(later))
    with pytest.raises(StopIteration) as stop:
        decision(later)().send(None)
    assert stop.value.value == 3


def test_definitions_are_reusable():
    definition = define()

    def first():
        return 1

    def second():
        return 2

    one, two = definition(first), definition(second)
    env = aec_env(calling(one, two, one), [one, two])
    assert decisions(play(env, 4)) == ["first_0", "second_0", "first_0"]
    assert env.unwrapped.simulation.log == [4, 4, 4]


def test_sentinels_stay_themselves():
    for sentinel in (RULE, TRUNCATED):
        assert pickle.loads(pickle.dumps(sentinel)) is sentinel
        assert repr(sentinel).startswith("simenv_marl.")


GOAL = {"achieved_goal_mapping": list, "desired_goal_mapping": list, "compute_reward": abs}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"observation_space": 3}, "observation_space must be a gymnasium space"),
        ({"observation_space": None}, "observation_space must be"),
        ({"action_space": spaces.Discrete}, "action_space must be a gymnasium space"),
        ({"observation_space_mapping": None}, "observation_space_mapping must be callable"),
        ({"observation_space_mapping": [1.0, 2.0]}, "observation_space_mapping must be callable"),
        ({"reward_mapping": None}, "reward_mapping must be callable"),
        ({"reward_mapping": 1.0}, "reward_mapping must be callable"),
        ({"action_space_mapping": None}, "give one of action_space_mapping, apply and choices"),
        ({"action_space_mapping": [1, 2]}, "action_space_mapping must be a callable or a dict"),
        ({"action_space": spaces.Discrete(3), "action_space_mapping": {0: 1, 1: 2}}, "must have just the actions"),
        ({"action_space": spaces.Discrete(2), "action_space_mapping": {0: 1, 1: 2, 2: 3}}, "just the actions"),
        ({"action_space": spaces.Discrete(2, start=1), "action_space_mapping": {0: 1, 1: 2}}, "just the actions"),
        ({"action_space": spaces.Box(0, 1), "action_space_mapping": {0: 1}}, "needs a Discrete"),
        ({"apply": 3}, "apply must be callable"),
        ({"apply": print, "action_space_mapping": print}, "give one of"),
        ({"choices": list, "action_space_mapping": print}, "give one of"),
        ({"choices": list, "apply": print, "action_space_mapping": print}, "give one of"),
        ({"choices": [1, 2]}, "choices must be callable"),
        ({"choices": list, "action_space": spaces.Box(0, 1)}, "choices needs a Discrete"),
        ({"choices": list, "action_space": spaces.Discrete(3, start=1)}, "starts at 0"),
        ({"choices": list, "action_mask_mapping": list}, "leave action_mask_mapping out"),
        ({"action_mask_mapping": [1, 0]}, "action_mask_mapping must be callable"),
        ({"action_mask_mapping": list, "action_space": spaces.Box(0, 1)}, "needs a Discrete or MultiDiscrete"),
        ({"rule_action_mapping": 3}, "rule_action_mapping must be a callable or a dict"),
        ({"agent": 3}, "agent must be a name"),
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
        action_space=spaces.Discrete(2),
        action_space_mapping={0: "no", 1: "yes"},
        rule_action_mapping=lambda decided: 1,
        removed_by="package.module.function",
    )
    same = dataclasses.replace(definition, agent="ant_0")
    assert same.action_space_mapping(1) == "yes"
    assert same.rule_action_mapping is definition.rule_action_mapping
    assert same.removed_by == {"package.module.function": None}
    other = dataclasses.replace(
        definition,
        action_space=spaces.Discrete(3),
        action_space_mapping={0: "no", 1: "yes", 2: "maybe"},
        removed_by=["package.module.other"],
    )
    assert other.action_space_mapping(2) == "maybe"
    assert other.removed_by == {"package.module.other": None}
    with pytest.raises(DefinitionError, match="must have just the actions"):
        dataclasses.replace(definition, action_space=spaces.Discrete(3))


def test_make_step_asks_for_what_it_needs_and_takes_nothing_else():
    given = {
        "observation_space": spaces.Discrete(2),
        "observation_space_mapping": lambda: 0,
        "action_space": spaces.Discrete(2),
        "reward_mapping": lambda: 0,
    }
    assert isinstance(make_step(**given, action_space_mapping={0: 0, 1: 1}), Definition)
    for missing in given:
        with pytest.raises(TypeError, match=missing):
            make_step(**{name: value for name, value in given.items() if name != missing})
    with pytest.raises(TypeError, match="'reward'"):
        make_step(**given, reward=1)


async def flow():
    yield 1


@pytest.mark.parametrize(
    "function",
    [
        len,
        [].append,
        property(lambda self: 1),
        functools.partial(int),
        int,
        3,
        None,
        Pump().flow,
        math.sqrt,
        "name",
        flow,
    ],
    ids=plainly,
)
def test_only_functions_can_be_decided(function):
    with pytest.raises(PatchError, match="is an async generator function" if function is flow else None):
        define()(function)


@pytest.mark.parametrize(
    ("name", "call", "args", "kwargs"),
    [
        ("flow", lambda pump: pump.flow(1), ("self", 1, "l"), {"fast": False}),
        ("flow", lambda pump: pump.flow(1, "m"), ("self", 1, "m"), {"fast": False}),
        ("flow", lambda pump: pump.flow(1, fast=True), ("self", 1, "l"), {"fast": True}),
        ("flow", lambda pump: pump.flow(1, fast=True, unit=None), ("self", 1, None), {"fast": True}),
        ("flow", lambda pump: type(pump).flow(pump, 3), ("self", 3, "l"), {"fast": False}),
        ("rounded", lambda pump: pump.rounded(1), (1,), {}),
        ("rounded", lambda pump: type(pump).rounded(amount=1), (1,), {}),
        ("halved", lambda pump: pump.halved(1), (1,), {}),
        ("strongest", lambda pump: type(pump).strongest(), ("class",), {"factor": 1}),
        ("strongest", lambda pump: pump.strongest(factor=2), ("class",), {"factor": 2}),
        ("anything", lambda pump: pump.anything(), ("self",), {}),
        ("anything", lambda pump: pump.anything(1, 2, x=3), ("self", 1, 2), {"x": 3}),
        ("named", lambda pump: pump.named(), (), {"amount": 1}),
        ("named", lambda pump: pump.named(amount=2), (), {"amount": 2}),
    ],
)
def test_mappings_receive_the_arguments_bound_to_the_signature(name, call, args, kwargs):
    seen = {"observation": [], "reward": [], "mask": [], "agent": []}

    def mapping(kind, value):
        def record(*args, **kwargs):
            seen[kind].append((args, kwargs))
            return value

        return record

    class Copy(Pump):
        pass

    definition = define(
        observation_space_mapping=mapping("observation", [0, 0]),
        reward_mapping=mapping("reward", 0),
        action_mask_mapping=mapping("mask", [1] * 10),
        agent=mapping("agent", "agent_0"),
    )
    copy = Copy()
    setattr(Copy, name, definition(vars(Pump)[name]))
    env = aec_env(calling(lambda: call(copy), lambda: call(copy)), getattr(Copy, name))
    play(env, 3)
    named = {"self": copy, "class": Copy}
    expected = (tuple(named.get(value, value) for value in args), kwargs)
    # Twice at a decision; reward and observation once more at the end.
    assert seen["agent"] == [expected] * 2
    assert seen["mask"][:2] == [expected] * 2
    assert seen["observation"] == seen["reward"] == [expected] * 3
    assert env.unwrapped.simulation.log == [3, 3]


def told_by(env, *actions):
    """What the model is told where its decisions are answered so."""
    env.reset()
    for action in actions:
        env.step(action)
    return env.unwrapped.simulation.log


def test_apply_receives_the_action_and_then_the_arguments():
    def fill(tank, amount, unit="l", *, fast=False):
        return "rule"

    fill = define(apply=lambda *args, **kwargs: (args, kwargs))(fill)
    env = single_env(calling(lambda: fill("tank", 5), lambda: fill("tank", amount=6, fast=True)), fill)
    assert told_by(env, 1, 2) == [((1, "tank", 5, "l"), {"fast": False}), ((2, "tank", 6, "l"), {"fast": True})]


def test_choices_receive_the_arguments():
    def move(board, *, side):
        return "rule"

    move = define(choices=lambda board, *, side: [(board, side, n) for n in range(2)])(move)
    assert told_by(single_env(calling(lambda: move("board", side="left")), move), 1) == [("board", "left", 1)]


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
def test_what_actions_decide_and_which_are_illegal(changes, refused, actions, told):
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


def test_a_generator_functions_value_is_the_decision():
    def haggle(good):
        answer = yield good
        return answer + 1

    haggle = define()(haggle)
    env = single_env(calling(*[lambda: exhaust(haggle("tea"))] * 2), haggle)
    assert told_by(env, 7, RULE) == [([], 7), (["tea"], 101)]


def test_a_generator_decides_when_it_starts_and_not_when_it_is_made():
    level = [0]

    def haggle():
        yield

    haggle = define(observation_space_mapping=lambda: [level[0], 0])(haggle)

    def main(simulation):
        generator = haggle()
        level[0] = 1
        exhaust(generator)

    assert single_env(script(main), haggle).reset()[0].tolist() == [1, 0]


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


class Twice:
    """Decorated in its class, and once more from outside."""

    @define(action_space_mapping=lambda action: "first")
    def decide(self):
        return "rule"


FIRST = Twice.decide
Twice.decide = define(action_space_mapping=lambda action: "second")(Twice.decide)


@pytest.mark.parametrize(
    ("named", "expected"), [(f"{__name__}.Twice.decide", "second"), (Twice.decide, "second"), (FIRST, "first")]
)
def test_the_bare_name_means_the_latest_definition_and_pickles_bring_the_one_that_was_named(named, expected):
    def call():
        return Twice().decide()

    before = Twice.decide, FIRST
    env = single_env(calling(call), named)
    assert told_by(env, 0) == [expected]
    pickled = cloudpickle.dumps(env)
    assert told_by(cloudpickle.loads(pickled), 0) == [expected]
    assert (Twice.decide, FIRST) == before  # what is defined in this process stays as it is
    assert told_by(single_env(calling(call), named), 0) == [expected]


def test_environments_choose_their_rewards():
    decide = decision()
    envs = [
        single_env(calling(decide, decide), {decide: define(reward_mapping=lambda value=value: value)})
        for value in (1.0, 2.0)
    ]
    for env in envs:
        env.reset()
    for _ in range(2):
        assert [env.step(0)[1] for env in envs] == [1.0, 2.0]


def masked(mask, **changes):
    return decision(action_space=spaces.Discrete(3), action_mask_mapping=lambda: mask, **changes)


def test_masks_stand_in_infos_where_the_user_cannot_open_them():
    mask = np.array([0, 1, 1], np.int8)
    decide = masked(mask)
    env = single_env(calling(decide, decide), decide)
    _, info = env.reset()
    assert info["action_mask"].dtype == np.int8
    info["action_mask"][:] = 1
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step(0)
    assert env.step(1)[4]["action_mask"].tolist() == [0, 1, 1]
    aec = aec_env(calling(decide), decide)
    aec.reset()
    assert aec.infos["choose_0"]["action_mask"].tolist() == aec.last()[4]["action_mask"].tolist() == [0, 1, 1]
    assert aec.infos["choose_0"]["action_mask"].dtype == np.int8


def test_masks_of_multi_discrete_spaces():
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


def test_the_mask_also_stands_in_a_dict_observation_with_that_key():
    space = spaces.Dict({"observation": spaces.Box(0, 1, (2,)), "action_mask": spaces.MultiBinary(3)})
    decide = masked([0, 1, 0], observation_space=space, observation_space_mapping=lambda: {"observation": [0.5, 1]})
    env = single_env(calling(decide), decide)
    observation, info = env.reset()
    assert observation["action_mask"].tolist() == info["action_mask"].tolist() == [0, 1, 0]
    assert observation["action_mask"].dtype == np.int8
    assert observation["action_mask"] is not info["action_mask"]
    assert observation in space
    observation, *_ = env.step(1)
    assert observation in space


def test_choices_are_asked_once_and_make_the_mask():
    made = []

    def moves():
        made.append(["a", "b", "c"][: 3 - len(made)])
        return iter(made[-1])

    decide = decision(action_space=spaces.Discrete(4), choices=moves)
    env = single_env(calling(decide, decide), decide)
    _, info = env.reset()
    assert info["action_mask"].tolist() == [1, 1, 1, 0]
    assert info["action_mask"].dtype == np.int8
    assert env.step(2)[4]["action_mask"].tolist() == [1, 1, 0, 0]
    assert len(made) == 2
    assert env.unwrapped.simulation.log == ["c"]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"choices": list}, "choices"),
        ({"choices": lambda: range(5)}, "choices"),
        ({"action_mask_mapping": lambda: [0] * 4}, "no legal action"),
        ({"action_mask_mapping": lambda: [1] * 3}, "shape"),
    ],
)
def test_no_choices_too_many_and_wrong_masks_are_errors(changes, match):
    decide = decision(action_space=spaces.Discrete(4), **changes)
    with pytest.raises(MaskError, match=match):
        single_env(calling(decide), decide).reset()


def test_choices_that_are_used_up_at_the_end_are_no_error():
    moves = ["a"]
    decide = decision(action_space=spaces.Discrete(2), choices=lambda: moves)
    env = single_env(calling(decide, moves.clear), decide)
    env.reset()
    terminated = env.step(0)[2]
    assert terminated


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

    def __init__(self, *steps):
        self.count, self.steps = 100, steps

    @define(agent="reader_0", reward_mapping=difference(lambda self: self.count))
    def read(self):
        return 0

    @define(agent="watcher_0", reward_mapping=lambda self: 2 * USED(self))
    def watch(self):
        return 0


USED = difference(lambda self: float(self.count))


class Metering(Script):
    def __init__(self):
        super().__init__(None)

    def run(self):
        meter = Meter()
        for step in (1, 10, 100):
            meter.read()
            meter.count += step
            meter.watch()
            meter.count += step


def test_differences_count_for_each_agent_since_it_was_last_asked():
    env = aec_env(Metering, [Meter.read, Meter.watch])
    for _ in range(2):  # each episode counts anew
        turns = play(env)
        assert rewards_of(turns, "reader_0") == [2.0, 20.0, 200.0]
        assert rewards_of(turns, "watcher_0") == [2 * 11.0, 2 * 110.0, 2 * 100.0]


def test_differences_of_two_environments_do_not_mix():
    first, second = (aec_env(Metering, [Meter.read, Meter.watch]) for _ in range(2))
    first.reset()
    second.reset()
    seen = {first: [], second: []}
    for env in [first, second, second, first, first, first, second, second] * 3:
        if env.agents:
            _, reward, terminated, *_ = env.last()
            seen[env].append((env.agent_selection, reward))
            env.step(None if terminated else RULE)
    expected = [(turn.agent, turn.reward) for turn in play(aec_env(Metering, [Meter.read, Meter.watch]))]
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
