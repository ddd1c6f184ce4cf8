"""Which action a decision of the rule corresponds to, for those who learn from the rule."""

import asyncio

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, parallel_env, single_env
from simenv_marl.data import collect_episodes
from simenv_marl.errors import InvalidActionError
from tests.worlds.entities import beings, life
from tests.worlds.models import EVERY_DRIVER, calling, decision, fails, play, script


def in_turn(values):
    remaining = iter(values)
    return lambda: next(remaining)


def begun(source, function, **options):
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
@EVERY_DRIVER
def test_info_has_the_rule_action_of_the_latest_decision_only(mapping, told):
    function = decision(in_turn([10, 20, 30]), rule_action_mapping=mapping)
    env = begun(calling(*[function] * 4), function)
    expected = [{} if action is None else {"rule_action": action} for action in told]
    assert [env.step(action)[4] for action in (RULE, 7, RULE, RULE)] == expected
    assert env.simulation.log == [10, 7, 20, 30]


@pytest.mark.parametrize(
    ("mapping", "error", "match", "note"),
    [
        (
            lambda tens: tens,
            InvalidActionError,
            "the rule's decision 10 to the action 10",
            "seed 3",
        ),
        ({20: 4}, InvalidActionError, "no action for the rule's decision 10", "in_turn"),
        (lambda tens: 1 / 0, ZeroDivisionError, "division", "seed 3"),
    ],
    ids=["outside the space", "not in the dict", "raising"],
)
def test_rule_action_mapping_errors_cannot_be_caught_by_the_model(mapping, error, match, note):
    function = decision(in_turn([10, 20, 30]), rule_action_mapping=mapping)

    def main(simulation):
        try:
            function()
        except Exception:
            simulation.log.append("swallowed")

    env = begun(script(main), function)
    with fails(error, note, match=match):
        env.step(RULE)
    assert env.simulation.log == []
    env.reset(seed=0)


def test_info_rule_action_is_right_if_a_rule_makes_other_decisions():
    inner = decision(lambda: 2, agent="inner_0", rule_action_mapping=lambda decided: decided)
    outer = decision(
        lambda: 10 * inner(), agent="outer_0", rule_action_mapping=lambda decided: decided // 5
    )
    wrong = decision(
        lambda: 10 * inner(), agent="wrong_0", rule_action_mapping=lambda decided: decided // 0
    )
    turns = play(aec_env(calling(outer, outer), [outer, inner]), RULE, seed=0)
    told = [(turn.agent, turn.info.get("rule_action")) for turn in turns]
    assert told == [("outer_0", None), ("inner_0", None), *[("outer_0", 4), ("inner_0", 2)] * 2]
    with fails(ZeroDivisionError, "of 'wrong_0'"):
        play(aec_env(calling(wrong), [wrong, inner]), RULE, seed=0)


def test_info_has_each_entitys_own_rule_action():
    points, names = (
        beings(rule_action_mapping=lambda decided, being: being.number),
        ["being_0", "being_1", "being_2"],
    )
    env = parallel_env(life("0 acts, 1 acts, 2 acts, 0 acts"), points, possible_agents=names)
    env.reset(seed=0)
    infos = env.step({"being_0": RULE, "being_1": 4, "being_2": RULE})[4]
    assert [infos[agent].get("rule_action") for agent in names] == [0, None, 2]


def test_info_rule_action_arrays_are_cast_and_copied():
    decided = np.array([0.25, 0.5])
    space = spaces.Box(0, 1, (2,), np.float32)
    function = decision(
        lambda: decided, action_space=space, rule_action_mapping=lambda value: value
    )
    env = begun(calling(*[function] * 4), function)
    action = env.step(RULE)[4]["rule_action"]
    assert action.dtype == np.float32
    action[:] = 0
    assert env.step(RULE)[4]["rule_action"].tolist() == [0.25, 0.5]
    assert decided.tolist() == [0.25, 0.5]


def test_rule_action_mapping_beside_apply_runs_after_the_rule():
    tank = {"level": 0}

    def pour():
        tank["level"] += 3

    fill = decision(
        pour, apply=lambda action: None, rule_action_mapping=lambda nothing: tank["level"]
    )
    # Changes after the decision do not count.
    last = lambda: tank.update(level=5)  # noqa: E731
    env = begun(calling(fill, fill, fill, last), fill)
    assert [env.step(RULE)[4]["rule_action"] for _ in range(3)] == [3, 6, 9]


@EVERY_DRIVER
def test_info_has_rule_actions_of_generators_and_coroutines():
    def slowly():
        yield "wait"
        return 3

    async def later():
        await asyncio.sleep(0)
        return 4

    def process():
        yield from slow()
        yield from slow()

    async def task():
        await late()
        await late()

    def main(simulation):
        simulation.log += process()
        asyncio.run(task())

    slow, late = (
        decision(rule, agent=rule.__name__, rule_action_mapping=lambda n: n + 1)
        for rule in (slowly, later)
    )
    env = aec_env(script(main), [slow, late])
    told = [(turn.agent, turn.info.get("rule_action")) for turn in play(env, RULE, seed=0)]
    assert told == [
        ("slowly", None),
        ("slowly", 4),
        ("later", None),
        ("later", 5),
        ("slowly", 4),
        ("later", 5),
    ]


MOVES = {0: "stay", 1: "north", 2: "south"}


@pytest.mark.parametrize(
    ("rule", "definition", "expected"),
    [
        ([10, 20, 30, 40], {"rule_action_mapping": lambda tens: tens // 10}, [1, 2, 3, 4]),
        ([10, 20, 30, 40], {}, [None] * 4),
        (["south", "elsewhere", "stay", "north"], {"action_space_mapping": MOVES}, [2, None, 0, 1]),
        (
            [["south"], "south", {"south": 1}, "stay"],
            {"action_space_mapping": MOVES},
            [None, 2, None, 0],
        ),
        (["go"] * 4, {"action_space_mapping": {0: "stay", 1: "stay", 2: "go"}}, [None] * 4),
        ([[3]] * 4, {"action_space_mapping": {0: [1], 1: [2], 2: [3]}}, [None] * 4),
        (
            ["b", "a", "a", "z"],
            {"choices": [["a", "b"], ["b", "c", "a"], ["a"], ["b", "d"]]},
            [1, 2, 0, None],
        ),
    ],
    ids=["mapping", "nothing", "dict", "unhashable", "ambiguous", "lists", "choices"],
)
def test_collect_episodes_returns_the_actions_of_the_rule(rule, definition, expected):
    if "choices" in definition:
        definition = {"choices": in_turn([*definition["choices"], ["a"]])}
    given = {"action_space": spaces.Discrete(3)} if "rule_action_mapping" not in definition else {}
    function = decision(in_turn(rule), **given, **definition)
    found = collect_episodes(calling(*[function] * 4), {function: RULE}, seeds=[0])[function]
    assert found.by_rule.all()
    assert found.known.tolist() == [action is not None for action in expected]
    assert found.actions.tolist() == [action or 0 for action in expected]
