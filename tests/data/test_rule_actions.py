"""Which action a decision of the rule corresponds to, for those who learn from the rule."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    aec_env,
    joint_env,
    make_step,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.data import collect_episodes
from simenv_marl.errors import DefinitionError, InvalidActionError
from tests.worlds.models import calling, decision, notes, play, script

DRIVERS = pytest.mark.parametrize("driver", ["greenlet", "thread"])


def counting(start: int = 1) -> Any:
    """A rule that decides 10, 20, 30, ..."""
    tens = {"now": 10 * (start - 1)}

    def choose(step: int = 10) -> int:
        tens["now"] += step
        return tens["now"]

    return choose


def four(function: Any) -> Any:
    """A simulation that asks four times."""

    def main(simulation: Any) -> None:
        simulation.log += [function() for _ in range(4)]

    return script(main)


def single(function: Any, **options: Any) -> Any:
    env = single_env(four(function), function, **options)
    env.reset(seed=0)
    return env


# -- infos ------------------------------------------------------------------------------------------


@DRIVERS
def test_the_next_info_tells_the_rules_action_and_only_that_of_the_latest_decision(driver):
    env = single(decision(counting(), rule_action_mapping=lambda tens: tens // 10), driver=driver)
    assert [env.step(action)[4] for action in (RULE, 7, RULE, RULE)] == [
        {"rule_action": 1},
        {},
        {"rule_action": 2},
        {"rule_action": 3},
    ]
    assert env.simulation.log == [10, 7, 20, 30]


def test_a_dict_goes_from_decision_to_action():
    env = single(decision(counting(), rule_action_mapping={10: 4, 20: 5, 30: 6, 40: 7}))
    assert [env.step(RULE)[4]["rule_action"] for _ in range(4)] == [4, 5, 6, 7]


def test_a_dict_without_the_decision_says_so():
    env = single(decision(counting(), rule_action_mapping={10: 4}))
    env.step(RULE)
    with pytest.raises(InvalidActionError, match="no action for the rule's decision 20") as caught:
        env.step(RULE)
    assert "choose" in notes(caught.value)


def test_a_mapping_may_take_the_arguments_of_the_call_as_they_were_passed():
    seen = []

    def mapping(decided, *args, **kwargs):
        seen.append((decided, args, kwargs))
        return 1

    function = decision(counting(), rule_action_mapping=mapping)

    def main(simulation):
        function(5)
        function(step=7)
        function()

    env = single_env(script(main), function)
    env.reset(seed=0)
    for _ in range(3):
        env.step(RULE)
    assert seen == [(5, (5,), {}), (12, (), {"step": 7}), (22, (), {})]


def test_none_says_that_no_action_corresponds():
    env = single(decision(counting(), rule_action_mapping=lambda tens: None if tens == 20 else 1))
    assert [env.step(RULE)[4] for _ in range(3)] == [{"rule_action": 1}, {}, {"rule_action": 1}]


def test_an_action_outside_the_space_is_an_error():
    env = single(decision(counting(), rule_action_mapping=lambda tens: tens))
    with pytest.raises(InvalidActionError, match="the rule's decision 10 to the action 10"):
        env.step(RULE)
    env.reset(seed=0)


def test_a_mapping_that_raises_surfaces_outside_the_models_own_try():
    function = decision(counting(), rule_action_mapping=lambda tens: 1 / 0)

    def main(simulation):
        try:
            function()
        except ZeroDivisionError:
            simulation.log.append("swallowed")

    env = single_env(script(main), function)
    env.reset(seed=3)
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(RULE)
    assert "seed 3" in notes(caught.value)
    assert env.simulation.log == []


def test_its_note_names_whose_rule_has_decided():
    inner = decision(counting(), agent="inner_0")
    outer = decision(lambda: inner(), agent="outer_0", rule_action_mapping=lambda tens: 1 / 0)
    env = aec_env(calling(outer), [outer, inner])
    env.reset()
    env.step(RULE)
    assert env.agent_selection == "inner_0"
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(1)
    assert "of 'outer_0'" in notes(caught.value)


@pytest.mark.parametrize("wrong", [3, "name"])
def test_what_is_no_mapping_is_refused(wrong):
    with pytest.raises(DefinitionError, match="rule_action_mapping"):
        decision(rule_action_mapping=wrong)


def test_arrays_are_cast_and_nobody_elses():
    decided = np.array([0.25, 0.5])
    function = decision(
        lambda: decided,
        action_space=spaces.Box(0, 1, (2,), np.float32),
        rule_action_mapping=lambda value: value,
    )
    env = single(function)
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

    point = make_step(
        observation_space=spaces.Discrete(100),
        observation_space_mapping=lambda tank: tank.level,
        action_space=spaces.Discrete(10),
        apply=lambda action, tank: setattr(tank, "level", tank.level + action),
        rule_action_mapping=lambda nothing, tank: tank.level % 10,
        reward_mapping=lambda tank: 0.0,
    )
    Tank.fill = point(Tank.fill)

    def main(simulation):
        tank = Tank()
        for _ in range(3):
            tank.fill()
        tank.level = 50  # what comes after is not looked at

    env = single_env(script(main), Tank.fill)
    env.reset(seed=0)
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
            simulation.log.append((yield from slowly()))
            simulation.log.append((yield from slowly()))

        simulation.log += list(process())

        async def twice():
            simulation.log.append(await later())
            simulation.log.append(await later())

        asyncio.run(twice())

    env = aec_env(script(main), [slowly, later], driver=driver)
    turns = play(env, RULE, seed=0)
    assert [(turn.agent, turn.info.get("rule_action")) for turn in turns] == [
        ("slow_0", None),
        ("slow_0", 4),
        ("late_0", None),
        ("late_0", 5),
        ("slow_0", 4),
        ("late_0", 5),
    ]
    assert env.simulation.log == [3, 3, "wait", "wait", 4, 4]


class Sheep:
    def __init__(self, number: int) -> None:
        self.name, self.number = f"sheep_{number}", number

    def move(self) -> int:
        return self.number * 10


def sheep(**changes: Any) -> Any:
    defined: dict[str, Any] = {
        "observation_space": spaces.Discrete(10),
        "observation_space_mapping": lambda sheep: sheep.number,
        "action_space": spaces.Discrete(10),
        "action_space_mapping": lambda action: 10 * action,
        "reward_mapping": lambda sheep: 0.0,
        "agent": lambda sheep: sheep.name,
        "rule_action_mapping": lambda decided: decided // 10,
    }
    return {f"{__name__}.Sheep.move": make_step(**defined | changes)}


def herd(simulation: Any) -> None:
    flock = [Sheep(number) for number in range(3)]
    for _ in range(2):
        simulation.log += [each.move() for each in flock]


def test_entities_have_each_their_own():
    turns = play(aec_env(script(herd), sheep()), RULE, seed=0)
    assert [(turn.agent, turn.info.get("rule_action")) for turn in turns[3:6]] == [
        ("sheep_0", 0),
        ("sheep_1", 1),
        ("sheep_2", 2),
    ]


def test_decisions_within_rules_do_not_take_each_others_place():
    inner = decision(lambda: 2, agent="inner_0", rule_action_mapping=lambda decided: decided)
    outer = decision(lambda: 10 * inner(), agent="outer_0", rule_action_mapping=lambda decided: decided // 5)

    def main(simulation):
        simulation.log += [outer(), outer()]

    turns = play(aec_env(script(main), [outer, inner]), RULE, seed=0)
    assert [(turn.agent, turn.info.get("rule_action")) for turn in turns] == [
        ("outer_0", None),
        ("inner_0", None),
        ("outer_0", 4),
        ("inner_0", 2),
        ("outer_0", 4),
        ("inner_0", 2),
    ]


def test_rounds_tell_it_too():
    roster = ["sheep_0", "sheep_1", "sheep_2"]
    env = parallel_env(script(herd), sheep(), possible_agents=roster)
    env.reset(seed=0)
    infos = env.step({"sheep_0": RULE, "sheep_1": 4, "sheep_2": RULE})[4]
    assert [infos[agent].get("rule_action") for agent in roster] == [0, None, 2]
    env.close()
    env = joint_env(script(herd), sheep(), possible_agents=roster)
    env.reset(seed=0)
    env.step(RULE)
    assert env.simulation.log == [0, 10, 20]
    env.close()


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
    function, seen = decision(counting(), rule_action_mapping=lambda tens: tens // 10), []

    def policy(observations, infos):
        seen.extend(info.get("rule_action") for info in infos)
        return [RULE] * len(infos)

    simulate_many(four(function), {function: policy}, seeds=[0])
    alone = []
    function = decision(counting(), rule_action_mapping=lambda tens: tens // 10)
    simulate(four(function), {function: lambda _, info: alone.append(info.get("rule_action")) or RULE}, seed=0)
    assert seen == alone == [None, 1, 2, 3]


# -- what was collected -----------------------------------------------------------------------------


def test_episodes_that_were_collected_have_the_actions_of_the_rule():
    function = decision(counting(), rule_action_mapping=lambda tens: tens // 10)
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert found.by_rule.all()
    assert found.known.all()
    assert found.actions.tolist() == [1, 2, 3, 4]


def test_a_policy_may_decide_some_of_them():
    function = decision(counting(), rule_action_mapping=lambda tens: tens // 10)
    answers = iter([RULE, 9, RULE, 8])
    found = collect_episodes(four(function), {function: lambda observations: [next(answers)]}, seeds=[0])[function]
    assert found.actions.tolist() == [1, 9, 2, 8]
    assert found.by_rule.tolist() == [True, False, True, False]
    assert found.known.all()


def test_dicts_are_read_backwards():
    moves = {0: "stay", 1: "north", 2: "south"}
    rule = iter(["south", "elsewhere", "stay", "north"])
    function = decision(lambda: next(rule), action_space=spaces.Discrete(3), action_space_mapping=moves)
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert found.actions.tolist() == [2, 0, 0, 1]
    assert found.known.tolist() == [True, False, True, True]


@pytest.mark.parametrize("moves", [{0: "stay", 1: "stay", 2: "go"}, {0: [1], 1: [2], 2: [3]}])
def test_dicts_that_cannot_be_read_backwards_leave_the_action_unknown(moves):
    function = decision(lambda: moves[2], action_space=spaces.Discrete(3), action_space_mapping=moves)
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert not found.known.any()
    assert found.actions.tolist() == [0] * 4


def test_choices_are_recognised():
    offers = [["a", "b"], ["b", "c", "a"], ["a"], ["b", "d"]]
    rule = iter(["b", "a", "a", "z"])
    function = decision(
        lambda: next(rule), action_space=spaces.Discrete(3), choices=lambda: offers.pop(0) if offers else ["a"]
    )
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert found.actions.tolist() == [1, 2, 0, 0]
    assert found.known.tolist() == [True, True, True, False]


def test_without_any_mapping_it_is_unknown():
    function = decision(counting())
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert found.by_rule.all()
    assert not found.known.any()


@pytest.mark.parametrize("workers", [0, 2])
def test_entities_that_were_collected(workers):
    found = collect_episodes(Herd, {f"{__name__}.Sheep.move": RULE}, points=sheep(), seeds=range(5), workers=workers)
    (herds,) = found.values()
    assert herds.known.all()
    assert herds.actions.tolist() == herds.observations.tolist() == [0, 0, 1, 1, 2, 2] * 5


class Herd:
    def reset(self) -> None:
        self.log: list[Any] = []

    def run(self) -> None:
        herd(self)


def test_the_one_of_many_that_tells_it_is_told_it():
    """Also where the point has no name of its own, and the others follow the policy."""

    def pair(simulation):
        simulation.flock = one, other = Sheep(0), Sheep(1)
        for _ in range(3):
            simulation.log += [one.move(), other.move()]

    turns = play(aec_env(script(pair), sheep()), {"sheep_0": RULE, "sheep_1": 3}, seed=0)
    told = [(turn.agent, turn.info.get("rule_action")) for turn in turns]
    assert told == [("sheep_0", None), ("sheep_1", None), *[("sheep_0", 0), ("sheep_1", None)] * 3]


@pytest.mark.parametrize("decided", [["go"], {"go": 1}])
def test_decisions_that_cannot_be_looked_up_correspond_to_no_action(decided):
    rule = iter([decided, "go", decided, "stay"])
    function = decision(lambda: next(rule), action_space=spaces.Discrete(2), action_space_mapping={0: "stay", 1: "go"})
    found = collect_episodes(four(function), {function: RULE}, seeds=[0])[function]
    assert found.known.tolist() == [False, True, False, True]
    assert found.actions[found.known].tolist() == [1, 0]
