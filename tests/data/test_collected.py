"""Whole episodes of all agents as arrays: ``collect_episodes``, beside a like AEC environment."""

from collections import defaultdict

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, aec_env
from simenv_marl.data import collect_episodes
from simenv_marl.errors import AgentError, NoDecisionError, OptionValueError, UnknownPointError
from simenv_marl.experiments import Variant
from tests.contract.test_simulate_many import by_row, ones
from tests.extent import examples
from tests.worlds.entities import (
    AnnouncingColony,
    Being,
    Colony,
    Other,
    beings,
    colony_designs,
    colony_points,
    life,
    others,
)
from tests.worlds.models import Timed, calling, decision, play, script
from tests.worlds.random_worlds import World, points_of, world_designs, world_policy

some_seeds = st.lists(st.integers(0, 2**31 - 1), max_size=6)
sizes = st.integers(1, 8)


def played(env, policies, seed):
    """What each agent lives through in an episode: by agent its rows, and its last observation."""
    rows, last, turn = defaultdict(list), {}, 0
    try:
        turns = play(env, lambda agent, env: policies(agent)(*env.last()[::4]), seed=seed)
    except NoDecisionError:
        return {}, {}
    for agent, observation, reward, terminated, truncated, info, action in turns:
        if rows[agent]:
            rows[agent][-1] |= {"reward": reward, "elapsed": info.get("elapsed")}
        if action is None:
            last[agent] = observation
            if rows[agent]:
                rows[agent][-1] |= {
                    "terminated": terminated,
                    "truncated": truncated,
                    "turn of the end": turn,
                }
            continue
        told = {
            "observation": observation,
            "action": action,
            "turn": turn,
            "terminated": False,
            "truncated": False,
        }
        rows[agent].append(told | {"mask": info.get("action_mask"), "time": info.get("time")})
        turn += 1
    return {agent: own for agent, own in rows.items() if own}, last


def check(found, episodes, chosen):
    """Compare the collection under one key with the ``played`` turns of its agents."""
    trajectory = row = 0
    following = found.next_observations
    for number, (agents, last) in enumerate(episodes):
        for agent, rows in agents.items():  # in the order of their first decisions
            if not chosen(agent):
                continue
            assert (found.starts[trajectory], found.lengths[trajectory]) == (row, len(rows))
            assert np.array_equal(found.last_observations[trajectory], last[agent])
            assert found.last_turns[trajectory] == rows[-1]["turn of the end"]
            assert found.returns[trajectory] == pytest.approx(sum(row["reward"] for row in rows))
            upcoming = [*(row["observation"] for row in rows[1:]), last[agent]]
            for step, expected in enumerate(rows):
                assert found.names[found.agents[row]] == agent
                assert (found.episodes[row], found.steps[row], found.turns[row]) == (
                    number,
                    step,
                    expected["turn"],
                )
                assert np.array_equal(found.observations[row], expected["observation"])
                assert np.array_equal(following[row], upcoming[step])
                assert found.by_rule[row] == (expected["action"] is RULE)
                assert found.by_rule[row] or found.actions[row] == expected["action"]
                assert found.rewards[row] == expected["reward"]
                assert found.terminations[row] == expected["terminated"]
                assert found.truncations[row] == expected["truncated"]
                if found.action_masks is not None:
                    assert found.action_masks[row].tolist() == expected["mask"].tolist()
                if found.times is not None:
                    assert found.times[row] == expected["time"]
                    elapsed = np.nan if expected["elapsed"] is None else expected["elapsed"]
                    assert np.array_equal(found.elapsed[row], elapsed, equal_nan=True)
                row += 1
            trajectory += 1
    assert (len(found), len(found.starts)) == (row, trajectory)


@given(colony_designs, some_seeds, sizes, st.booleans(), st.none() | st.integers(1, 12))
@examples(60)
def test_collect_episodes_matches_aec_env_with_births_and_deaths(
    design, seeds, size, announcing, most
):
    def policy(observation, info):
        number = int(observation.sum()) % 6
        return RULE if number == 5 else number

    def simulation():
        return (AnnouncingColony if announcing else Colony)(design)

    points = colony_points(overseen=bool(design.overseen))
    given = {"points": points, "max_steps": most}
    found = collect_episodes(
        simulation, dict.fromkeys(points, by_row(policy)), seeds=seeds, batch_size=size, **given
    )
    env = aec_env(simulation, **given)
    episodes = [played(env, lambda agent: policy, seed) for seed in seeds]
    assert found.keys() == points.keys()
    # as long as the environment is there, the class has others in their place
    act, *oversee = points
    check(found[act], episodes, lambda agent: agent != "overseer_0")
    for point in oversee:
        check(found[point], episodes, lambda agent: agent == "overseer_0")


@given(world_designs(), some_seeds, sizes)
@examples(80)
def test_collect_episodes_matches_aec_env_in_random_models(design, seeds, size):
    def simulation():
        return World(design, points)

    points = points_of(design)
    given = {"points": points, "max_steps": design.max_steps}
    answered = {
        points[number]: by_row(world_policy)
        for number in range(len(points))
        if number not in design.rules
    }
    found = collect_episodes(simulation, answered, seeds=seeds, batch_size=size, **given)
    env = aec_env(simulation, policies={points[number]: RULE for number in design.rules}, **given)
    episodes = [played(env, lambda agent: world_policy, seed) for seed in seeds]
    for number, point in enumerate(points):
        if point in answered:
            check(
                found[point],
                episodes,
                lambda agent, number=number: agent.split("_")[1] == str(number),
            )


def test_collect_episodes_keeps_each_agents_data_under_its_key():
    points = beings(observation_space_mapping=lambda being: [being.number, 0], removed_by=())
    policies = {
        Being.act: ones,
        "being_1": lambda observations: [2] * len(observations),
        "being_2": RULE,
    }
    source = life("0 acts, 1 acts, 2 acts, 1 acts, 0 acts")
    found = collect_episodes(source, policies, points=points, seeds=[3, 4])
    assert list(found) == [Being.act, "being_1", "being_2"]
    assert found["being_2"].by_rule.tolist() == [True] * 2
    assert found["being_1"].actions.tolist() == [2] * 4
    assert found["being_1"].seeds == (3, 4)
    for (key, own), number in zip(found.items(), (0, 1, 2), strict=True):
        assert own.names == (f"being_{number}",), key
        assert own.observations[:, 0].tolist() == [number] * len(own)


def test_collect_episodes_arrays_have_the_documented_shapes_and_dtypes():
    ant = decision(
        agent="ant_0",
        observation_space=spaces.Box(0, 9, (2, 3), np.float32),
        observation_space_mapping=lambda: np.ones((2, 3)),
        action_mask_mapping=lambda: [0, 1] + [0] * 8,
    )
    found = collect_episodes(lambda: Timed(calling(ant, ant)().main), {ant: ones}, seeds=range(3))[
        ant
    ]
    for shape, dtype, names in (
        ((6,), np.float64, "rewards times elapsed"),
        ((6,), np.bool_, "terminations truncations by_rule"),
        ((6,), np.int64, "actions episodes agents steps turns"),
        ((3,), np.float64, "returns"),
        ((3,), np.int64, "starts lengths last_turns"),
        ((6, 2, 3), np.float32, "observations next_observations"),
        ((3, 2, 3), np.float32, "last_observations"),
        ((6, 10), np.int8, "action_masks"),
    ):
        for name in names.split():
            array = getattr(found, name)
            assert (array.shape, array.dtype) == (shape, dtype), name
    assert found.times.tolist() == [0, 10] * 3
    assert found.elapsed.tolist() == [10, 10] * 3
    assert len(found) == 6
    assert "6 decisions" in repr(found)


def test_collect_episodes_stacks_composite_observations_and_actions():
    ant = decision(
        agent="ant_0",
        observation_space=spaces.Dict(
            a=spaces.Discrete(5), b=spaces.Tuple([spaces.Box(0, 9, (2,)), spaces.Text(5)])
        ),
        observation_space_mapping=lambda: {"a": 3, "b": ([1, 2], "ant")},
        action_space=spaces.Dict(c=spaces.Box(0, 9, (2,)), d=spaces.MultiDiscrete([3, 3])),
    )
    bee = decision(
        agent="bee_0",
        action_space=spaces.MultiDiscrete([2, 3]),
        action_mask_mapping=lambda: ([0, 1], [1, 0, 0]),
    )
    answers = iter([[{"c": np.array([1, 2], np.float32), "d": np.array([0, 2])}, RULE], RULE])
    policies = {
        ant: lambda observations: next(answers),
        bee: lambda observations: [[1, 0]] * len(observations),
    }
    found = collect_episodes(calling(ant, ant, bee), policies, seeds=range(2))
    of_ant, of_bee = found.values()
    assert of_ant.observations["a"].tolist() == [3] * 4
    assert of_ant.observations["b"][0].shape == (4, 2)
    assert of_ant.next_observations["b"][1].tolist() == ["ant"] * 4
    assert of_ant.actions["c"].tolist() == [[1, 2], [0, 0], [0, 0], [0, 0]]
    assert of_ant.actions["d"].tolist() == [[0, 2], [0, 0], [0, 0], [0, 0]]
    assert of_ant.by_rule.tolist() == [False, True, True, True]
    assert [part.tolist() for part in of_bee.action_masks] == [[[0, 1]] * 2, [[1, 0, 0]] * 2]
    assert of_bee.actions.tolist() == [[1, 0]] * 2


def test_collect_episodes_policies_get_decision_ids_and_can_return_extras():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    buffer = np.zeros((3, 2), np.float32)

    def policy(observations, infos, identities):
        assert len(observations) == len(infos) == len(identities)
        own = buffer[: len(identities)]  # which is used again
        own[:] = identities
        observations[:] = 99  # which is its own
        return ones(observations), {"seeds": [seed for seed, _ in identities], "arrays": own}

    for size in (1, 2, 3):
        found = collect_episodes(
            calling(ant, bee, ant), {ant: policy, bee: ones}, seeds=[7, 5, 9], batch_size=size
        )
        own = found[ant]
        assert (
            own.extras["seeds"].tolist()
            == [own.seeds[episode] for episode in own.episodes]
            == [7, 7, 5, 5, 9, 9]
        )
        assert own.extras["arrays"][:, 1].tolist() == own.turns.tolist() == [0, 2] * 3
        assert own.extras["arrays"].dtype == np.float32
        assert own.observations.tolist() == [[1, 2]] * 6


@pytest.mark.parametrize(
    ("second", "match"),
    [({"values": [1.0]}, "2 decisions"), ({"values": 1.0}, "2 decisions"), (None, "values")],
)
def test_collect_episodes_refuses_extras_of_a_wrong_length(second, match):
    ant = decision(agent="ant_0")
    answers = iter(
        [([1, 1], {"values": [0.5, 1.5]}), [1, 1] if second is None else ([1, 1], second)]
    )
    with pytest.raises(OptionValueError, match=match):
        collect_episodes(
            calling(ant, ant), {ant: lambda observations: next(answers)}, seeds=range(2)
        )


def test_collect_episodes_returns_empty_arrays_of_agents_that_never_decide():
    ant, bee = decision(agent="ant_0", action_space=spaces.Box(0, 1, (2,))), decision(agent="bee_0")
    source = script(lambda simulation: bee() if simulation.seed % 2 else None)
    found = collect_episodes(source, {ant: ones, bee: ones}, points=[ant, bee], seeds=range(4))
    assert found[bee].episodes.tolist() == [1, 3]
    assert found[bee].action_space == spaces.Discrete(10)
    nothing = found[ant]
    assert len(nothing) == 0
    assert nothing.action_space == spaces.Box(0, 1, (2,))
    assert nothing.agents.dtype == nothing.episodes.dtype == np.int64
    assert (
        nothing.observations.shape
        == nothing.next_observations.shape
        == nothing.actions.shape
        == (0, 2)
    )
    assert nothing.seeds == (0, 1, 2, 3)
    assert len(collect_episodes(source, {ant: ones}, seeds=[])[ant]) == 0
    unborn = collect_episodes(source, {"being_3": ones}, points=beings(), seeds=[1])
    assert unborn["being_3"].action_space is None


def test_collect_function_is_called_with_each_simulation():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")

    def found(policies, **options):
        # the last end first
        source = script(lambda simulation: [ant() and None for _ in range(simulation.seed)])
        return collect_episodes(source, policies, points=[ant, bee], seeds=[4, 0, 2], **options)

    both = {ant: ones, bee: ones}
    collected = found(both, collect=lambda simulation: simulation.seed)
    # also of whom has never decided
    assert collected[ant].collected == collected[bee].collected == (4, 0, 2)
    assert found(both)[ant].collected is None
    assert found({}) == {}
    for wrong in ({"collect": 3}, {"batch_size": 0}, {"batch_size": 1.5}, {"workers": 1.5}):
        with pytest.raises(OptionValueError, match=next(iter(wrong))):
            found(both, **wrong)
    for policies, error, told in (
        ([1], OptionValueError, "policies"),
        ({"nobody": ones}, UnknownPointError, "nobody"),
    ):
        with pytest.raises(error, match=told):
            found(policies)


def test_collect_episodes_refuses_one_agent_name_with_different_spaces():
    space = {"observation_space": spaces.Discrete(3), "observation_space_mapping": lambda other: 1}
    points = beings() | others(agent=lambda other: f"being_{other.number}", **space)
    source = script(lambda simulation: (Being if simulation.seed else Other)(0).act() and None)
    with pytest.raises(AgentError, match="being_0"):
        collect_episodes(source, {"being_0": ones}, points=points, seeds=range(2))


def test_collect_episodes_returns_only_agents_whose_policies_are_given():
    asked = []
    ant, bee = (
        decision(agent="ant_0"),
        decision(agent="bee_0", reward_mapping=lambda: asked.append(1) or 0.0),
    )
    variant = Variant(
        "own", calling(ant, bee), points=[ant, bee], policies={bee: lambda observation: 5}
    )
    found = collect_episodes(
        variant, {ant: ones}, seeds=range(2), collect=lambda simulation: simulation.log
    )
    assert list(found) == [ant]
    assert found[ant].turns.tolist() == [0, 0]
    assert found[ant].collected == ([1, 5], [1, 5])
    found = collect_episodes(calling(ant, bee, ant), {"ant_0": ones}, points=[ant, bee], seeds=[1])
    assert found["ant_0"].turns.tolist() == [0, 1]
    assert asked == []
