"""Which action a decision of the rule corresponds to, for those who learn from the rule."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, joint_env, parallel_env, simulate, simulate_many, single_env, vector_env
from simenv_marl.data import collect_episodes
from simenv_marl.errors import DefinitionError, InvalidActionError
from tests.worlds.models import calling, decision, define, notes, play, script

DRIVERS = pytest.mark.parametrize("driver", ["greenlet", "thread"])


def counting() -> Any:
    tens = iter(range(10, 100, 10))
    return lambda: next(tens)


def four(function: Any) -> Any:
    def main(simulation: Any) -> None:
        simulation.log += [function() for _ in range(4)]

    return script(main)


def begun(source: Any, function: Any, **options: Any) -> Any:
    env = single_env(source, function, **options)
    env.reset(seed=3)
    return env


@pytest.mark.parametrize(
    ("mapping", "told"),
    [
        (lambda tens: tens // 10, [1, None, 2, 3]),
        ({10: 4, 20: 5, 30: 6}, [4, None, 5, 6]),
        (lambda tens: None if tens == 20 else 1, [1, None, None, 1]),
    ],
    ids=["callable", "dict", "none"],
)
@DRIVERS
def test_the_next_info_tells_the_rules_action_and_only_that_of_the_latest_decision(mapping, told, driver):
    function = decision(counting(), rule_action_mapping=mapping)
    env = begun(four(function), function, driver=driver)
    expected = [{} if action is None else {"rule_action": action} for action in told]
    assert [env.step(action)[4] for action in (RULE, 7, RULE, RULE)] == expected
    assert env.simulation.log == [10, 7, 20, 30]


def test_a_mapping_may_take_the_arguments_of_the_call_as_they_were_passed():
    seen = []

    def mapping(decided, *args, **kwargs):
        seen.append((decided, args, kwargs))
        return 1

    function = decision(lambda step=10: step + 1, rule_action_mapping=mapping)
    env = begun(script(lambda simulation: [function(5), function(step=7), function()].clear()), function)
    for _ in range(3):
        env.step(RULE)
    assert seen == [(6, (5,), {}), (8, (), {"step": 7}), (11, (), {})]


@pytest.mark.parametrize(
    ("mapping", "error", "match", "note"),
    [
        (lambda tens: tens, InvalidActionError, "the rule's decision 10 to the action 10", "seed 3"),
        ({20: 4}, InvalidActionError, "no action for the rule's decision 10", "counting"),
        (lambda tens: 1 / 0, ZeroDivisionError, "division", "seed 3"),
    ],
    ids=["outside the space", "not in the dict", "raising"],
)
def test_errors_surface_outside_the_models_own_try(mapping, error, match, note):
    function = decision(counting(), rule_action_mapping=mapping)

    def main(simulation):
        try:
            function()
        except Exception:
            simulation.log.append("swallowed")

    env = begun(script(main), function)
    with pytest.raises(error, match=match) as caught:
        env.step(RULE)
    assert note in notes(caught.value)
    assert env.simulation.log == []
    env.reset(seed=0)


def test_decisions_within_rules_do_not_take_each_others_place():
    inner = decision(lambda: 2, agent="inner_0", rule_action_mapping=lambda decided: decided)
    outer = decision(lambda: 10 * inner(), agent="outer_0", rule_action_mapping=lambda decided: decided // 5)
    wrong = decision(lambda: 10 * inner(), agent="wrong_0", rule_action_mapping=lambda decided: decided // 0)
    turns = play(aec_env(calling(outer, outer), [outer, inner]), RULE, seed=0)
    told = [(turn.agent, turn.info.get("rule_action")) for turn in turns]
    assert told == [("outer_0", None), ("inner_0", None), *[("outer_0", 4), ("inner_0", 2)] * 2]
    with pytest.raises(ZeroDivisionError) as caught:
        play(aec_env(calling(wrong), [wrong, inner]), RULE, seed=0)
    assert "of 'wrong_0'" in notes(caught.value)


@pytest.mark.parametrize("wrong", [3, "name"])
def test_what_is_no_mapping_is_refused(wrong):
    with pytest.raises(DefinitionError, match="rule_action_mapping"):
        decision(rule_action_mapping=wrong)


def test_arrays_are_cast_and_nobody_elses():
    decided = np.array([0.25, 0.5])
    space = spaces.Box(0, 1, (2,), np.float32)
    function = decision(lambda: decided, action_space=space, rule_action_mapping=lambda value: value)
    env = begun(four(function), function)
    action = env.step(RULE)[4]["rule_action"]
    assert action.dtype == np.float32
    action[:] = 0
    assert env.step(RULE)[4]["rule_action"].tolist() == [0.25, 0.5]
    assert decided.tolist() == [0.25, 0.5]


def test_with_apply_it_is_asked_when_the_rule_has_decided_in_place():
    class Tank:
        level = 0

        def fill(self) -> None:
            self.level += 3

    point = define(
        observation_space=spaces.Discrete(100),
        observation_space_mapping=lambda tank: tank.level,
        apply=lambda action, tank: setattr(tank, "level", tank.level + action),
        rule_action_mapping=lambda nothing, tank: tank.level % 10,
    )
    Tank.fill = point(Tank.fill)

    def main(simulation):
        tank = Tank()
        for _ in range(3):
            tank.fill()
        tank.level = 50  # what comes after is not looked at

    env = begun(script(main), Tank.fill)
    assert [env.step(RULE)[4]["rule_action"] for _ in range(3)] == [3, 6, 9]


@DRIVERS
def test_generators_and_coroutines(driver):
    def choose_slowly():
        yield "wait"
        return 3

    async def choose_later():
        await asyncio.sleep(0)
        return 4

    slowly = decision(choose_slowly, rule_action_mapping=lambda decided: decided + 1, agent="slow_0")
    later = decision(choose_later, rule_action_mapping=lambda decided: decided + 1, agent="late_0")

    def main(simulation):
        def process():
            for _ in range(2):
                simulation.log.append((yield from slowly()))

        async def twice():
            for _ in range(2):
                simulation.log.append(await later())

        simulation.log += list(process())
        asyncio.run(twice())

    env = aec_env(script(main), [slowly, later], driver=driver)
    told = [(turn.agent, turn.info.get("rule_action")) for turn in play(env, RULE, seed=0)]
    assert told == [("slow_0", None), ("slow_0", 4), ("late_0", None), ("late_0", 5), ("slow_0", 4), ("late_0", 5)]
    assert env.simulation.log == [3, 3, "wait", "wait", 4, 4]


class Sheep:
    def __init__(self, number: int) -> None:
        self.name, self.number = f"sheep_{number}", number

    def move(self) -> int:
        return self.number * 10


class Herd:
    def __init__(self, number: int = 3) -> None:
        self.number = number

    def reset(self) -> None:
        self.log: list[Any] = []

    def run(self) -> None:
        self.flock = [Sheep(number) for number in range(self.number)]
        for _ in range(2):
            self.log += [each.move() for each in self.flock]


ROSTER = ["sheep_0", "sheep_1", "sheep_2"]
SHEEP = {
    f"{__name__}.Sheep.move": define(
        observation_space=spaces.Discrete(10),
        observation_space_mapping=lambda sheep: sheep.number,
        action_space_mapping=lambda action: 10 * action,
        agent=lambda sheep: sheep.name,
        rule_action_mapping=lambda decided: decided // 10,
    )
}


def test_rounds_tell_it_too():
    env = parallel_env(Herd, SHEEP, possible_agents=ROSTER)
    env.reset(seed=0)
    infos = env.step({"sheep_0": RULE, "sheep_1": 4, "sheep_2": RULE})[4]
    assert [infos[agent].get("rule_action") for agent in ROSTER] == [0, None, 2]
    env = joint_env(Herd, SHEEP, possible_agents=ROSTER)
    env.reset(seed=0)
    env.step(RULE)
    assert env.simulation.log == [0, 10, 20]


def test_simulations_and_vectors_run_as_they_did():
    function = decision(counting(), rule_action_mapping=lambda tens: 1)
    assert simulate(four(function), {function: lambda observation: RULE}, seed=0).log == [10, 20, 30, 40]
    envs = vector_env(four(function), function, num_envs=2)
    envs.reset(seed=0)
    for _ in range(3):
        assert envs.step([1, 2])[4] == {}
    assert [simulation.log for simulation in envs.get_attr("simulation")] == [[], []]
    envs.step([1, 2])
    assert [simulation.log for simulation in envs.get_attr("simulation")] == [[1] * 4, [2] * 4]
    envs.close()


def test_batched_policies_get_it_in_their_infos_as_single_ones_do():
    seen = []

    def alone(observation, info):
        seen.append(info.get("rule_action"))
        return RULE

    def batched(observations, infos):
        return [alone(None, info) for info in infos]

    for run, own, seeds in ((simulate_many, batched, {"seeds": [0]}), (simulate, alone, {"seed": 0})):
        function = decision(counting(), rule_action_mapping=lambda tens: tens // 10)
        run(four(function), {function: own}, **seeds)
    assert seen == [None, 1, 2, 3] * 2


MOVES = {0: "stay", 1: "north", 2: "south"}


@pytest.mark.parametrize(
    ("rule", "definition", "expected"),
    [
        ([10, 20, 30, 40], {"rule_action_mapping": lambda tens: tens // 10}, [1, 2, 3, 4]),
        ([10, 20, 30, 40], {}, [None] * 4),
        (["south", "elsewhere", "stay", "north"], {"action_space_mapping": MOVES}, [2, None, 0, 1]),
        ([["south"], "south", {"south": 1}, "stay"], {"action_space_mapping": MOVES}, [None, 2, None, 0]),
        (["go"] * 4, {"action_space_mapping": {0: "stay", 1: "stay", 2: "go"}}, [None] * 4),
        ([[3]] * 4, {"action_space_mapping": {0: [1], 1: [2], 2: [3]}}, [None] * 4),
        (["b", "a", "a", "z"], {"choices": [["a", "b"], ["b", "c", "a"], ["a"], ["b", "d"]]}, [1, 2, 0, None]),
    ],
    ids=["mapping", "nothing", "dict", "unhashable", "ambiguous", "lists", "choices"],
)
def test_episodes_that_were_collected_have_the_actions_of_the_rule(rule, definition, expected):
    if "choices" in definition:
        offers = iter([*definition["choices"], ["a"]])
        definition = {"choices": lambda: next(offers)}
    given = {"action_space": spaces.Discrete(3)} if "rule_action_mapping" not in definition else {}
    decided = iter(rule)
    function = decision(lambda: next(decided), **given, **definition)
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert found.by_rule.all()
    assert found.known.tolist() == [action is not None for action in expected]
    assert found.actions.tolist() == [action or 0 for action in expected]


def test_a_policy_may_decide_some_of_them():
    function = decision(counting(), rule_action_mapping=lambda tens: tens // 10)
    answers = iter([RULE, 9, RULE, 8])
    found = collect_episodes(four(function), {function: lambda observations: [next(answers)]}, seeds=[0])[function]
    assert found.actions.tolist() == [1, 9, 2, 8]
    assert found.by_rule.tolist() == [True, False, True, False]
    assert found.known.all()


@pytest.mark.parametrize("workers", [0, 2])
def test_entities_that_were_collected(workers):
    (herds,) = collect_episodes(
        Herd, dict.fromkeys(SHEEP, RULE), points=SHEEP, seeds=range(5), workers=workers
    ).values()
    assert herds.known.all()
    assert herds.actions.tolist() == herds.observations.tolist() == [0, 0, 1, 1, 2, 2] * 5


@pytest.mark.parametrize(
    ("actions", "told"), [(RULE, [0, 1, 0, 1]), ({"sheep_0": RULE, "sheep_1": 3}, [0, None, 0, None])]
)
def test_entities_are_told_each_their_own(actions, told):
    turns = play(aec_env(lambda: Herd(2), SHEEP), actions, seed=0)
    found = [(turn.agent, turn.info.get("rule_action")) for turn in turns]
    assert found == list(zip(["sheep_0", "sheep_1"] * 3, [None, None, *told], strict=True))
