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

# -- outside any environment ----------------------------------------------------------------------


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
        """An integer."""
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
    def bare(self) -> "Pump":
        return self

    @define()
    def anything(self, *args: int, **kwargs: int) -> Any:
        return args, kwargs


class BigPump(Pump):
    power = 30


def test_outside_any_environment_a_decision_function_is_the_rule():
    pump = Pump()
    assert pump.flow(1.5) == (1.5, "l", False)
    assert pump.flow(1.5, "m") == (1.5, "m", False)
    assert pump.flow(1.5, unit="m", fast=True) == (1.5, "m", True)
    assert Pump.flow(pump, 2) == (2, "l", False)
    assert pump.bare() is pump
    assert pump.anything(1, 2, amount=3) == ((1, 2), {"amount": 3})
    assert pump.anything() == ((), {})


def test_statics_and_class_methods_keep_their_binding():
    for held, kind in (("rounded", staticmethod), ("halved", staticmethod), ("strongest", classmethod)):
        assert type(vars(Pump)[held]) is kind
    assert Pump.rounded(2.5) == Pump().rounded(2.5) == 2
    assert Pump.halved(3) == BigPump().halved(3) == 1.5
    assert (Pump.strongest(), BigPump.strongest(factor=2), BigPump().strongest()) == (3, 60, 30)
    assert (Pump.weakest(), BigPump().weakest()) == (-3, -30)


def test_a_decision_function_keeps_its_looks():
    assert Pump.flow.__name__ == "flow"
    assert Pump.flow.__qualname__ == "Pump.flow"
    assert Pump.flow.__module__ == __name__
    assert Pump.flow.__doc__ == "How much flows."
    assert str(
        inspect.signature(Pump.flow)
    ) == "(self, amount: float, /, unit: str = 'l', *, fast: bool = False) -> " + ("tuple[typing.Any, ...]")
    assert str(inspect.signature(Pump().flow)).startswith("(amount: float, /, unit: str = 'l'")
    assert inspect.isfunction(Pump.flow)
    assert inspect.ismethod(Pump().flow)
    assert Pump.strongest.__doc__ == "The power."
    assert Pump.rounded.__name__ == "rounded"


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


def test_the_signature_is_the_rules_where_annotations_are_asked_for():
    assert typing.get_type_hints(Pump.rounded) == {"amount": float, "return": int}


def test_the_rule_is_what_was_decorated():
    def rule():
        return 1

    assert decision(rule).__wrapped__ is rule
    assert Pump.flow.__wrapped__(Pump(), 4) == (4, "l", False)


def test_wrong_calls_are_type_errors_as_without_decoration():
    pump = Pump()
    wrong = [
        lambda: pump.flow(),
        lambda: pump.flow(1, 2, 3),
        lambda: pump.flow(amount=1),
        lambda: pump.flow(1, speed=2),
        lambda: pump.bare(1),
        lambda: Pump.bare(),
        lambda: Pump.rounded(),
        lambda: Pump.strongest(2),
    ]
    for call in wrong:
        with pytest.raises(TypeError):
            call()


def test_wrong_calls_are_type_errors_inside_too_and_no_decisions():
    seen = []

    def rule(amount, unit="l", *, fast):
        return "rule"

    decide = decision(rule, observation_space_mapping=lambda *args, **kwargs: seen.append((args, kwargs)) or [0, 0])

    def main(simulation):
        for wrong in (
            lambda: decide(),
            lambda: decide(1),
            lambda: decide(1, 2, 3, fast=True),
            lambda: decide(1, fast=True, slow=True),
            lambda: decide(1, amount=1, fast=True),
        ):
            with pytest.raises(TypeError):
                wrong()
        decide(1, fast=True)

    env = single_env(script(main), decide)
    env.reset()
    assert seen == [((1,), {"fast": True})]


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


def test_a_decision_function_can_be_decorated_by_others():
    @functools.lru_cache
    @define()
    def choose(x):
        return [x]

    assert choose(1) is choose(1)


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


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"observation_space": 3},
        {"observation_space": None},
        {"action_space": [0, 1]},
        {"action_space": spaces.Discrete},
        {"observation_space_mapping": None},
        {"observation_space_mapping": [1.0, 2.0]},
        {"reward_mapping": None},
        {"reward_mapping": 1.0},
        {"action_space_mapping": None},
        {"action_space_mapping": 3},
        {"action_space_mapping": [1, 2]},
        {"action_space": spaces.Discrete(3), "action_space_mapping": {0: 1, 1: 2}},
        {"action_space": spaces.Discrete(2), "action_space_mapping": {0: 1, 1: 2, 2: 3}},
        {"action_space": spaces.Discrete(2, start=1), "action_space_mapping": {0: 1, 1: 2}},
        {"action_space": spaces.Box(0, 1), "action_space_mapping": {0: 1}},
        {"apply": 3},
        {"apply": lambda action: action, "action_space_mapping": lambda action: action},
        {"choices": lambda: [1], "action_space_mapping": lambda action: action},
        {"choices": lambda: [1], "apply": lambda action: action, "action_space_mapping": lambda action: action},
        {"choices": [1, 2]},
        {"choices": lambda: [1], "action_space": spaces.Box(0, 1)},
        {"choices": lambda: [1], "action_space": spaces.Discrete(3, start=1)},
        {"choices": lambda: [1], "action_mask_mapping": lambda: [1] * 10},
        {"action_mask_mapping": [1, 0]},
        {"action_mask_mapping": lambda: [1], "action_space": spaces.Box(0, 1)},
        {"agent": 3},
        {"agent": ""},
        {"agent": ["a"]},
    ],
    ids=plainly,
)
def test_definitions_that_cannot_work_are_refused(changes):
    with pytest.raises(DefinitionError, match="make_step") as caught:
        define(**changes)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    "missing", ["observation_space", "observation_space_mapping", "action_space", "reward_mapping"]
)
def test_what_make_step_needs_is_asked_for(missing):
    given = {
        "observation_space": spaces.Discrete(2),
        "observation_space_mapping": lambda: 0,
        "action_space": spaces.Discrete(2),
        "action_space_mapping": {0: 0, 1: 1},
        "reward_mapping": lambda: 0,
    }
    assert isinstance(make_step(**given), Definition)
    del given[missing]
    with pytest.raises(TypeError, match=missing):
        make_step(**given)


def test_make_step_takes_no_unknown_arguments():
    with pytest.raises(TypeError, match="reward"):
        define(reward=1)


@pytest.mark.parametrize(
    "function",
    [len, [].append, property(lambda self: 1), functools.partial(int), int, 3, None, Pump().bare, math.sqrt, "name"],
    ids=plainly,
)
def test_only_functions_can_be_decided(function):
    with pytest.raises(PatchError):
        define()(function)


def test_an_async_generator_cannot_be_decided():
    async def flow():
        yield 1

    with pytest.raises(PatchError, match="is an async generator function"):
        define()(flow)


# -- what mappings receive ------------------------------------------------------------------------


class Recorder:
    """Mappings that write down the arguments which they get."""

    def __init__(self):
        self.calls: dict[str, list[Any]] = {}

    def mapping(self, name, value):
        def record(*args, **kwargs):
            self.calls.setdefault(name, []).append((args, kwargs))
            return value

        return record

    def definition(self, **changes):
        return define(
            observation_space_mapping=self.mapping("observation", [0, 0]),
            reward_mapping=self.mapping("reward", 0),
            action_mask_mapping=self.mapping("mask", [1] * 10),
            agent=self.mapping("agent", "agent_0"),
            **changes,
        )


class Tank:
    """Undecorated; each test decorates a copy of it."""

    def fill(self, amount, unit="l", *, fast=False):
        return "rule"

    def drain(self):
        return "rule"

    @staticmethod
    def measure(amount, unit="l"):
        return "rule"

    @classmethod
    def build(cls, size=1):
        return "rule"

    def mixed(self, *amounts, **options):
        return "rule"

    def strict(self, amount, /, unit="l"):
        return "rule"

    @staticmethod
    def named(*, amount=1):
        return "rule"


@pytest.mark.parametrize(
    ("name", "call", "args", "kwargs"),
    [
        ("fill", lambda tank: tank.fill(1), ("self", 1), {}),
        ("fill", lambda tank: tank.fill(1, "m"), ("self", 1, "m"), {}),
        ("fill", lambda tank: tank.fill(amount=1), ("self",), {"amount": 1}),
        ("fill", lambda tank: tank.fill(1, fast=True), ("self", 1), {"fast": True}),
        ("fill", lambda tank: tank.fill(unit="m", amount=2), ("self",), {"unit": "m", "amount": 2}),
        ("fill", lambda tank: type(tank).fill(tank, 3), ("self", 3), {}),
        ("drain", lambda tank: tank.drain(), ("self",), {}),
        ("measure", lambda tank: tank.measure(1), (1,), {}),
        ("measure", lambda tank: type(tank).measure(1, unit="m"), (1,), {"unit": "m"}),
        ("build", lambda tank: type(tank).build(), ("class",), {}),
        ("build", lambda tank: tank.build(size=2), ("class",), {"size": 2}),
        ("mixed", lambda tank: tank.mixed(), ("self",), {}),
        ("mixed", lambda tank: tank.mixed(1, 2, x=3), ("self", 1, 2), {"x": 3}),
        ("named", lambda tank: tank.named(), (), {}),
        ("named", lambda tank: tank.named(amount=2), (), {"amount": 2}),
        ("strict", lambda tank: tank.strict(1), ("self", 1), {}),
        ("strict", lambda tank: tank.strict(1, unit=None), ("self", 1), {"unit": None}),
    ],
)
def test_mappings_receive_the_arguments_as_they_were_passed(name, call, args, kwargs):
    recorder = Recorder()

    class Copy(Tank):
        pass

    copy = Copy()
    setattr(Copy, name, recorder.definition()(vars(Tank)[name]))
    env = aec_env(calling(lambda: call(copy), lambda: call(copy)), getattr(Copy, name))
    play(env, 3)
    named = {"self": copy, "class": Copy}
    expected = (tuple(named.get(value, value) if isinstance(value, str) else value for value in args), kwargs)
    # Twice at a decision; reward and observation once more at the end.
    assert recorder.calls["agent"] == [expected] * 2
    assert recorder.calls["mask"][:2] == [expected] * 2
    assert recorder.calls["observation"] == [expected] * 3
    assert recorder.calls["reward"] == [expected] * 3
    assert env.unwrapped.simulation.log == [3, 3]


def test_apply_receives_the_action_and_then_the_arguments():
    seen = []

    def fill(tank, amount, unit="l", *, fast=False):
        return "rule"

    fill = define(apply=lambda *args, **kwargs: seen.append((args, kwargs)) or "applied")(fill)
    env = single_env(calling(lambda: fill("tank", 5), lambda: fill("tank", amount=6, fast=True)), fill)
    env.reset()
    env.step(1)
    env.step(2)
    assert seen == [((1, "tank", 5), {}), ((2, "tank"), {"amount": 6, "fast": True})]
    assert env.unwrapped.simulation.log == ["applied", "applied"]


def test_choices_receive_the_arguments():
    def move(board, *, side):
        return "rule"

    move = define(choices=lambda board, *, side: [(board, side, n) for n in range(2)])(move)
    env = single_env(calling(lambda: move("board", side="left")), move)
    env.reset()
    env.step(1)
    assert env.unwrapped.simulation.log == [("board", "left", 1)]


# -- what an action decides -----------------------------------------------------------------------


def test_a_dict_maps_actions_to_decisions():
    decide = decision(action_space=spaces.Discrete(3), action_space_mapping={0: "a", 1: None, 2: RuntimeError})
    env = single_env(calling(decide, decide, decide), decide)
    env.reset()
    for action in (2, 1, 0):
        env.step(action)
    assert env.unwrapped.simulation.log == [RuntimeError, None, "a"]


def test_a_dict_may_start_anywhere():
    decide = decision(action_space=spaces.Discrete(2, start=-1), action_space_mapping={-1: "down", 0: "stay"})
    env = single_env(calling(decide, decide), decide)
    env.reset()
    with pytest.raises(InvalidActionError, match="is not in its action space"):
        env.step(1)
    env.step(np.int64(-1))
    env.step(0)
    assert env.unwrapped.simulation.log == ["down", "stay"]


def test_changing_the_dict_afterwards_changes_nothing():
    answers = {0: "a", 1: "b"}
    decide = decision(action_space=spaces.Discrete(2), action_space_mapping=answers)
    answers[0] = "changed"
    env = single_env(calling(decide), decide)
    env.reset()
    env.step(0)
    assert env.unwrapped.simulation.log == ["a"]


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


def test_decisions_may_be_none():
    decide = decision(action_space_mapping=lambda action: None)
    env = single_env(calling(decide), decide)
    env.reset()
    env.step(1)
    assert env.unwrapped.simulation.log == [None]


# -- generators and coroutines --------------------------------------------------------------------


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
    env.reset()
    env.step(7)
    env.step(RULE)
    assert env.unwrapped.simulation.log == [([], 7), (["tea"], 101)]


def test_a_generator_decides_when_it_starts_and_not_when_it_is_made():
    observed = []
    level = [0]

    def haggle():
        yield
        return 0

    haggle = define(observation_space_mapping=lambda: observed.append(level[0]) or [0, 0])(haggle)

    def main(simulation):
        generator = haggle()
        level[0] = 1
        exhaust(generator)

    env = single_env(script(main), haggle)
    env.reset()
    assert observed == [1]


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
        env.reset()
        env.step(5)
        assert env.unwrapped.simulation.log == [expected]


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
        env.reset()
        env.step(5)
        env.step(RULE)
        assert env.unwrapped.simulation.log == [expected, ("rule", "tea")]


# -- many definitions -----------------------------------------------------------------------------


def decided_by(named, called):
    """What the environment of ``named`` makes the simulation get, which calls ``called``."""
    env = single_env(calling(called), named)
    env.reset()
    env.step(1)
    return env.unwrapped.simulation.log[0][0]


def test_one_function_may_have_many_definitions():
    early = decision(action_space_mapping=lambda action: ("early", action))
    late = define(action_space_mapping=lambda action: ("late", action))(early)
    last = define(action_space_mapping=lambda action: ("last", action))(late)
    assert early.__wrapped__ is late.__wrapped__ is last.__wrapped__
    for called in (early, late, last):
        assert [decided_by(named, called) for named in (early, late, last)] == ["early", "late", "last"]


class Twice:
    """Decorated in its class, and once more from outside."""

    @define(action_space_mapping=lambda action: "first")
    def decide(self):
        return "rule"


FIRST = Twice.decide
Twice.decide = define(action_space_mapping=lambda action: "second")(Twice.decide)


def test_the_bare_name_means_the_latest_definition():
    for points, expected in ((f"{__name__}.Twice.decide", "second"), (Twice.decide, "second"), (FIRST, "first")):
        env = single_env(calling(Twice().decide), points)
        env.reset()
        env.step(0)
        assert env.unwrapped.simulation.log == [expected]


def test_environments_choose_their_rewards():
    def rule():
        return 0

    decide = define()(rule)
    rewarded = {r: define(reward_mapping=lambda r=r: r) for r in (1.0, 2.0)}
    envs = [single_env(calling(decide, decide), {decide: definition}) for definition in rewarded.values()]
    for env in envs:
        env.reset()
    assert [env.step(0)[1] for env in envs] == [1.0, 2.0]
    assert [env.step(0)[1] for env in envs] == [1.0, 2.0]


# -- masks and choices ----------------------------------------------------------------------------


def masked(mask, **changes):
    return decision(action_space=spaces.Discrete(3), action_mask_mapping=lambda: mask, **changes)


@pytest.mark.parametrize("mask", [[0, 1, 1], (False, True, True), np.array([0, 1, 1]), np.array([0.0, 1.0, 1.0])])
def test_masks_stand_in_infos(mask):
    decide = masked(mask)
    env = single_env(calling(decide, decide), decide)
    _, info = env.reset()
    assert info["action_mask"].dtype == np.int8
    assert info["action_mask"].tolist() == [0, 1, 1]
    aec = aec_env(calling(decide), decide)
    aec.reset()
    assert aec.infos["choose_0"]["action_mask"].tolist() == aec.last()[4]["action_mask"].tolist() == [0, 1, 1]
    assert aec.infos["choose_0"]["action_mask"].dtype == np.int8


def test_a_masked_action_is_illegal_and_moves_nothing():
    decide = masked([0, 1, 1])
    env = single_env(calling(decide), decide)
    env.reset()
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step(0)
    assert env.unwrapped.simulation.log == []
    env.step(1)
    assert env.unwrapped.simulation.log == [1]


def test_the_user_cannot_open_the_mask():
    decide = masked(np.array([0, 1, 1], np.int8))
    env = single_env(calling(decide, decide), decide)
    _, info = env.reset()
    info["action_mask"][:] = 1
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step(0)
    assert env.step(1)[4]["action_mask"].tolist() == [0, 1, 1]


def test_rule_may_decide_what_is_masked():
    decide = masked([0, 1, 1])
    env = single_env(calling(decide), decide)
    env.reset()
    env.step(RULE)
    assert env.unwrapped.simulation.log == ["rule"]


def test_masks_of_spaces_that_do_not_start_at_zero():
    decide = decision(action_space=spaces.Discrete(2, start=5), action_mask_mapping=lambda: [0, 1])
    env = single_env(calling(decide), decide)
    env.reset()
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step(5)
    env.step(6)
    assert env.unwrapped.simulation.log == [6]


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


@pytest.mark.parametrize("mask", [[0, 0, 0], [1, 1], [1, 1, 1, 1], [1, 2, 0], 1, [[1, 1, 1]], [0.5, 1, 1]], ids=str)
def test_masks_that_fit_no_action_space_are_refused(mask):
    decide = masked(mask)
    with pytest.raises(MaskError, match="mask"):
        single_env(calling(decide), decide).reset()


def test_choices_are_asked_once_and_indexed():
    made = []

    def moves():
        made.append(["a", "b", "c"][: 3 - len(made)])
        return iter(made[-1])

    decide = decision(action_space=spaces.Discrete(4), choices=moves)
    env = single_env(calling(decide, decide), decide)
    _, info = env.reset()
    assert info["action_mask"].tolist() == [1, 1, 1, 0]
    assert info["action_mask"].dtype == np.int8
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step(3)
    info = env.step(2)[4]
    assert info["action_mask"].tolist() == [1, 1, 0, 0]
    assert len(made) == 2
    env.step(np.int64(0))
    assert env.unwrapped.simulation.log == ["c", "a"]


@pytest.mark.parametrize("number", [0, 5])
def test_no_choices_and_too_many_are_errors(number):
    decide = decision(action_space=spaces.Discrete(4), choices=lambda: range(number))
    with pytest.raises(MaskError, match="choices"):
        single_env(calling(decide), decide).reset()


def test_choices_that_are_used_up_at_the_end_are_no_error():
    moves = ["a"]
    decide = decision(action_space=spaces.Discrete(2), choices=lambda: moves)
    env = single_env(calling(decide, moves.clear), decide)
    env.reset()
    terminated = env.step(0)[2]
    assert terminated


# -- agents ---------------------------------------------------------------------------------------


def test_default_names_are_the_functions_letters_in_the_order_of_points():
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

    for points, names in (
        ([Left.Choose_water_2, Left.go, Right.go], ["choosewater_0", "go_0", "go_1"]),
        ([Right.go, Left.go], ["go_0", "go_1"]),
    ):
        env = aec_env(calling(Left().go, Right().go), points)
        assert env.possible_agents == names
        env.reset()
        assert env.agent_selection == names[points.index(Left.go)]


def test_default_names_do_not_collide_with_given_ones():
    def go():
        return 0

    def other():
        return 0

    given, default = define(agent="go_0")(other), define()(go)
    env = aec_env(calling(given, default), [default, given])
    assert sorted(env.possible_agents) == ["go_0", "go_1"]
    assert decisions(play(env)) == ["go_0", "go_1"]


def test_agents_that_a_callable_names():
    def decide(name):
        return "rule"

    decide = define(agent=lambda name: name)(decide)
    names = ["a", "b", None, "a", "c"]
    env = aec_env(calling(*[lambda name=name: decide(name) for name in names]), decide)
    assert not hasattr(env, "possible_agents")
    env.reset()
    assert env.agents == ["a"]
    turns = play(env, 1)
    assert decisions(turns) == ["a", "b", "a", "c"]
    assert env.unwrapped.simulation.log == [1, 1, "rule", 1, 1]


def test_agent_is_asked_at_every_decision_once():
    asked = []
    decide = decision(agent=lambda: asked.append(1) or "a_0")
    env = aec_env(calling(decide, decide), decide)
    env.reset()
    assert len(asked) == 1
    env.step(0)
    assert len(asked) == 2


# -- differences ----------------------------------------------------------------------------------


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


def test_differences_are_zero_the_first_time():
    seen = []
    change = difference(lambda: 5)

    def decide():
        return 0

    decide = define(reward_mapping=lambda: seen.append(change()) or 0)(decide)
    env = single_env(calling(decide), decide)
    for _ in range(2):
        env.reset()
        env.step(0)
    assert seen == [0.0, 0.0, 0.0, 0.0]


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


def test_differences_as_observations():
    count = [0]
    decide = decision(
        observation_space=spaces.Box(-100, 100, (), np.float32), observation_space_mapping=difference(lambda: count[0])
    )

    def main(simulation):
        for step in (3, 5):
            decide()
            count[0] += step

    env = single_env(script(main), decide)
    assert env.reset()[0] == 0
    assert [env.step(0)[0] for _ in range(2)] == [3, 5]


def test_differences_of_numbers_that_change_in_place():
    used = np.array(0.0)

    def main(simulation):
        for step in (3.0, 5.0):
            decide()
            np.add(used, step, out=used)

    decide = decision(reward_mapping=difference(lambda: used))
    env = single_env(script(main), decide)
    env.reset()
    assert [env.step(0)[1] for _ in range(2)] == [3.0, 5.0]


def test_differences_outside_any_environment_are_zero():
    count = iter(range(10))
    change = difference(lambda: next(count))
    assert [change(), change()] == [0.0, 0.0]


def test_difference_needs_a_callable():
    with pytest.raises(DefinitionError):
        difference(3)


# -- what comes back when a decision function was pickled -------------------------------------------


@pytest.mark.parametrize(("named", "expected"), [(FIRST, "first"), (Twice.decide, "second")])
def test_of_several_definitions_of_a_rule_the_same_one_comes_back(named, expected):
    def call():
        return Twice().decide()

    env = cloudpickle.loads(cloudpickle.dumps(single_env(calling(call), named)))
    env.reset()
    env.step(0)
    assert env.unwrapped.simulation.log == [expected]


def test_what_is_defined_in_this_process_stays_as_it_is():
    """Whatever was pickled before comes back beside it."""
    pickled = cloudpickle.dumps(single_env(calling(Twice().decide), Twice.decide))
    before = Twice.decide, FIRST
    cloudpickle.loads(pickled)
    assert (Twice.decide, FIRST) == before
    for named, expected in ((FIRST, "first"), (Twice.decide, "second")):
        env = single_env(calling(Twice().decide), named)
        env.reset()
        env.step(0)
        assert env.unwrapped.simulation.log == [expected]


# -- definitions made of definitions --------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"action_space": "nonsense"}, "action_space must be a gymnasium space"),
        ({"observation_space_mapping": 3}, "observation_space_mapping must be callable"),
        ({"apply": print}, "give one of action_space_mapping, apply and choices"),
        ({"action_space_mapping": None}, "give one of"),
        ({"action_space_mapping": {0: 1}}, "must have just the actions"),
        ({"action_space": spaces.Discrete(3)}, "must have just the actions"),
        ({"rule_action_mapping": 3}, "rule_action_mapping must be a callable or a dict"),
        ({"agent": ""}, "agent must be a name"),
        ({"removed_by": {3: None}}, "removed_by must be a dict from dotted names"),
        ({"goal_space": spaces.Discrete(3)}, "a goal needs all of its parts"),
    ],
)
def test_a_definition_that_is_replaced_in_part_is_checked_as_a_whole(changes, match):
    definition = define(action_space=spaces.Discrete(2), action_space_mapping={0: "no", 1: "yes"})
    with pytest.raises(DefinitionError, match=match):
        dataclasses.replace(definition, **changes)


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
        rule_action_mapping={"no": 0},
        removed_by=["package.module.other"],
    )
    assert other.action_space_mapping(2) == "maybe"
    assert other.rule_action_mapping == {"no": 0}
    assert other.removed_by == {"package.module.other": None}
