"""The frames of simulators in other processes: invalid ones, their rules' decisions, births."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, make_step, parallel_env, simulate
from simenv_marl.data import Mixture, collect_episodes, compare_with_rule
from simenv_marl.errors import DefinitionError, RemoteError, SimulationError, WireError
from simenv_marl.remote import ProcessSimulation
from tests.outside.reservoirs import PRICE, TELLING, Here, by_its_rule, child, command, reservoirs
from tests.processes import runs
from tests.worlds.models import begun, play
from tests.worlds.vectors import alike

pytestmark = pytest.mark.greenlet(
    "the rule's decision comes back within the simulation, whatever runs it"
)


def telling(points=TELLING):
    """The reservoirs in a process that tells what its rules decide."""
    return ProcessSimulation(command("tells"), points)


def sampled(agent, env):
    return env.action_space(agent).sample()


@pytest.mark.parametrize("choose", [RULE, sampled], ids=["rule", "sampled"])
def test_process_simulation_episode_equals_the_model_in_this_process(make_env, choose):
    envs = make_env(aec_env, telling()), make_env(aec_env, Here)
    for seed in range(3):
        theirs, ours = (play(env, choose, seed=seed) for env in envs)
        assert alike(theirs, ours)
        assert len({turn.agent for turn in ours}) > 3  # some are born
        assert any(turn.info.get("rule_action") is not None for turn in ours) == (choose is RULE)


def _closes(observations):
    return np.zeros((len(observations), 1))


def test_process_simulation_rule_can_be_compared_with_policies():
    found = [
        compare_with_rule(simulation, {name: _closes}, seeds=range(3), tolerance=0.5)[name]
        for simulation, name in ((telling(), "reservoir.inflow"), (Here, next(iter(Here.points))))
    ]
    assert 0 < found[0].agreement == found[1].agreement < 1
    mixed = collect_episodes(telling(), {"reservoir.inflow": Mixture({RULE: 1.0})}, seeds=[1])
    assert mixed["reservoir.inflow"].known.all()


def test_process_simulation_without_decided_frames_has_no_rule_actions():
    policies = {"broker_0": lambda observations: np.zeros(len(observations), int)}
    with pytest.raises(DefinitionError, match="the action of the rule is not known"):
        compare_with_rule(
            reservoirs({"broker.price": replace(PRICE, agent="broker_0")}), policies, seeds=[1]
        )


def test_process_simulation_apply_can_return_the_rules_decision():
    asked, late = [], []

    def apply(action, call, *, _rule):
        asked.append(_rule(call))
        late.append((_rule, call))
        return asked[-1]

    simulation = telling({"broker.price": replace(PRICE, action_space_mapping=None, apply=apply)})
    assert simulate(simulation, {"broker.price": lambda _: 0}, seed=1).result == by_its_rule(1)
    assert asked[0] == pytest.approx(1.1)
    assert [rule(call) for rule, call in late] == [RULE] * len(asked), "no decision is due any more"


def test_process_simulation_apply_cannot_replace_the_rules_decision():
    definition = replace(
        PRICE, action_space_mapping=None, apply=lambda action, call, *, _rule: 2 * _rule(call)
    )
    with pytest.raises(
        SimulationError, match=r"rule of broker\.price has decided 1\.1.* 2\.2.* cannot replace it"
    ):
        simulate(telling({"broker.price": definition}), {"broker.price": lambda _: 0}, seed=1)


SPEAKS = """
import os, sys
reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
lines = open(reading)
for frame in sys.argv[1:]:
    os.write(writing, frame.encode() + b"\\n")
    if any(word in frame for word in ('"hello"', '"decide"', '"end"')):
        lines.readline()
"""
HELLO = {"hello": 1, "points": ["sheep.graze"], "can": ["decided", "expect"]}


def call(number, name):
    return {"decide": number, "point": "sheep.graze", "entity": name, "args": {"hunger": 1}}


def expected(*names):
    return {
        "expect": [
            {"point": "sheep.graze", "entity": name, "args": {"hunger": 1}, "time": 0.5}
            for name in names
        ]
    }


CALL, NEXT = call(1, "a"), call(2, "a")
DROUGHT = {"error": {"type": "Drought", "text": "no water"}}
DECIDED = {"decided": 1, "value": 3}
GRAZE = make_step(
    observation_space=spaces.Box(0, 9, (1,), np.float32),
    observation_space_mapping=lambda call: [call.hunger],
    action_space=spaces.Discrete(5),
    action_space_mapping=lambda action: int(action),
    reward_mapping=lambda call: -float(call.hunger),
    agent=lambda call: call.entity,
)


def line(frame):
    return frame if isinstance(frame, str) else json.dumps(frame)


def both(*frames):
    """Frames that are sent together."""
    return "\n".join(map(line, frames))


def speaking(*frames):
    """A simulator that sends some frames or lines, whatever it receives."""
    return ProcessSimulation(
        [sys.executable, "-c", SPEAKS, *map(line, frames)], {"sheep.graze": GRAZE}
    )


@pytest.mark.parametrize(
    ("frames", "kind", "text"),
    [
        (["Welcome to the simulator!"], WireError, "Welcome to the simulator"),
        ([CALL], WireError, "began with .*decide.*, not with a hello"),
        ([{**HELLO, "hello": 2}], WireError, "speaks version 2 of the wire; this is version 1"),
        ([{**HELLO, "hello": True}], WireError, "speaks version True"),
        ([{**HELLO, "points": "sheep.graze"}], WireError, "must be lists of strings"),
        ([DROUGHT], RemoteError, "has raised Drought: no water"),
        ([both(HELLO, DROUGHT)], RemoteError, "has raised Drought: no water"),
        ([both(HELLO, CALL)], WireError, "has sent .*decide.* before the start of an episode"),
    ],
    ids=str,
)
def test_process_simulation_raises_errors_of_frames_before_the_start(frames, kind, text):
    with pytest.raises(kind, match=text):
        simulate(speaking(*frames), seed=1)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (NEXT, "'decide': 2"),
        ({"end": {}}, "'end'"),
        ({**DECIDED, "decided": 2}, "'decided': 2"),
        ({**DECIDED, "decided": True}, "'decided': True"),
        ({"decided": 1}, r"\{'decided': 1\}"),
    ],
    ids=str,
)
def test_process_simulation_error_names_a_frame_sent_instead_of_decided(frame, text):
    with pytest.raises(
        WireError, match=rf'has sent .*{text}.* where \{{"decided": 1, "value": \.\.\.\}} was due'
    ):
        simulate(speaking(HELLO, CALL, frame), seed=1)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ({"desire": 4}, "desire.*not a frame of the wire"),
        ({"error": "a dam broke"}, "a dam broke.*not a frame of the wire"),
        (DECIDED, "'decided'.* which is not due"),
        ({**NEXT, "decide": 7}, "call 7 where call 2 was due"),
        ({**NEXT, "decide": "2"}, "call '2' where call 2"),
        ({**NEXT, "point": "moon"}, "the point 'moon', which is not in its hello"),
        ({**NEXT, "point": ["a"]}, r"named the point \['a'\]"),
        ({**NEXT, "entity": ["a"]}, r"\['a'\] for sheep\.graze; an entity must be"),
        ({**NEXT, "args": [1]}, r"args .* not an object: \[1\]"),
        ({**NEXT, "time": "now"}, "the time 'now'"),
        ({**NEXT, "time": 10**400}, "the time 1000"),
        ({**NEXT, "end": {}}, "decide and end in one frame"),
        ({"end": True}, "the end True"),
        ({"end": {"truncated": "yes"}}, r"'yes'.*\"truncated\" \(true or false\)"),
        ({"remove": "a", "point": "moon"}, "the point 'moon'"),
        (
            {"update": "a", "point": "sheep.graze", "args": {"time": 3}},
            r"an argument 'time' for sheep\.graze",
        ),
        ({"expect": {"entity": "b"}}, '"expect" with .*must be a list of objects'),
        ({"expect": [CALL]}, '"expect" with .*must be a list of objects'),
        ({"expect": [{"point": "moon"}]}, "the point 'moon'"),
        (
            {"expect": [{"point": "sheep.graze", "args": {"entity": 3}}]},
            r"an argument 'entity' for sheep\.graze",
        ),
    ],
    ids=str,
)
def test_process_simulation_error_names_an_unexpected_frame(frame, text):
    with pytest.raises(WireError, match=f"(?s){text}"):
        simulate(speaking(HELLO, CALL, DECIDED, frame), seed=1)


@pytest.mark.parametrize("frame", [DECIDED, {"expect": []}])
def test_process_simulation_refuses_frames_that_were_not_announced(frame):
    with pytest.raises(WireError, match=r"not in the \"can\" of its hello"):
        simulate(speaking({**HELLO, "can": []}, CALL, frame), seed=1)


@pytest.mark.parametrize(
    ("frames", "born", "rounds"),
    [
        ([call(1, "a"), call(2, "b"), call(3, "c")], 1, 3),
        ([expected("a", "b", "c"), call(1, "a"), call(2, "b"), call(3, "c")], 3, 1),
        (
            [
                expected("a", "b"),
                call(1, "a"),
                call(2, "b"),
                expected("c", "d"),
                call(3, "c"),
                call(4, "d"),
            ],
            2,
            2,
        ),
    ],
    ids=["one by one", "together", "in mid-episode"],
)
def test_process_simulation_expected_agents_act_in_one_parallel_step(
    make_env, frames, born, rounds
):
    env = begun(
        make_env(parallel_env, speaking({**HELLO, "can": ["expect"]}, *frames, {"end": {}})), 1
    )
    assert len(env.agents) == born
    for _ in range(rounds):
        assert env.agents
        env.step(dict.fromkeys(env.agents, RULE))
    assert not env.agents


def test_process_simulation_expected_agents_observe_until_their_removal(make_env):
    first_day = [
        expected("a", "b"),
        call(1, "a"),
        call(2, "b"),
        {"remove": "a", "point": "sheep.graze"},
    ]
    second_day = [expected("b", "c", "d"), call(3, "b"), call(4, "c"), call(5, "d"), {"end": {}}]
    env = make_env(parallel_env, speaking({**HELLO, "can": ["expect"]}, *first_day, *second_day))
    observations, _ = env.reset(seed=1)
    assert list(observations) == ["a", "b"]
    observations, _, terminations, *_ = env.step(dict.fromkeys(env.agents, 3))
    assert observations.keys() == terminations.keys()
    assert terminations == {"a": True, "b": False, "c": False, "d": False}
    calls = env.simulation.expected_calls("sheep.graze")
    assert [(call.entity, call.time) for (call,) in calls] == [("c", 0.5), ("d", 0.5)], (
        "one decides now"
    )


def test_process_simulation_removed_agents_name_can_return(make_env):
    removed = [{"remove": name, "point": "sheep.graze"} for name in "ab"]
    frames = CALL, DECIDED, expected("b"), *removed, NEXT, {**DECIDED, "decided": 2}, {"end": {}}
    names = {}
    named = replace(GRAZE, agent=lambda call: names.setdefault(call, f"sheep_{len(names)}"))
    env = make_env(aec_env, speaking(HELLO, *frames), {"sheep.graze": named})
    play(env, seed=1)
    assert [call.entity for call in names] == ["a", "b", "a"]
    assert env.simulation.expected_calls("sheep.graze") == []


def test_process_simulation_mapping_error_ends_a_busy_process(make_env):
    rewards = [0.0]
    once = {"sheep.graze": replace(GRAZE, reward_mapping=lambda call: rewards.pop())}
    removed = {"remove": "a", "point": "sheep.graze"}
    env = begun(make_env(aec_env, speaking(HELLO, CALL, DECIDED, removed, {"end": {}}), once), 1)
    number = child(env)
    with pytest.raises(IndexError):
        env.step(RULE)
    assert not runs(number)


def test_process_simulation_without_expect_has_no_expected_calls():
    simulation = reservoirs()
    assert not hasattr(simulation, "expected_calls")
    simulation.reset(seed=1)
    assert not hasattr(simulation, "expected_calls")
