"""The states of simulations, for centralised critics: in trajectories, and for policies."""

import asyncio
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    evaluate,
    joint_env,
    simulate,
    simulate_many,
    turn_env,
)
from simenv_marl.data import (
    Mixture,
    collect_episodes,
    compare_with_rule,
    joint_policy,
    record_dataset,
    turn_policy,
)
from simenv_marl.errors import AgentError, NoDecisionError, ObservationError, OptionValueError
from simenv_marl.plugins import attach_handler, remove_handler
from tests.extent import examples
from tests.worlds.models import calling, decision, play
from tests.worlds.random_worlds import (
    HERE,
    YARD_PLAN,
    YARD_POINTS,
    YARD_ROSTER,
    Yard,
    YardDesign,
    seeds,
    yard_designs,
    yard_outcome,
    yard_policy,
)

SPACE = spaces.Box(0, 1e4, (2,), np.float32)
BUSY = YardDesign(machines=3, jobs=2, cranes=2, plans=2, luck=2, until=None)
PLANS = f"{HERE}.Yard.plan"


def busy():
    return Yard(BUSY)


def by_row(policy):
    return lambda observations: list(map(policy, observations))


def everywhere(policy):
    return dict.fromkeys(YARD_POINTS, policy)


def checking(observations, infos, *, _state):
    """A batched policy that checks the states that it gets, and gives them back."""
    assert _state.shape == (len(observations), 2)
    assert _state[:, 0].tolist() == observations[:, 2].tolist()
    assert _state[:, 1].tolist() == [info["time"] for info in infos]
    return list(map(yard_policy, observations)), {"seen": _state.copy()}


def checking_one(observation, info, *, _state):
    assert _state.tolist() == [observation[2], info["time"]]
    return yard_policy(observation)


# -- trajectories ---------------------------------------------------------------------------------


@given(yard_designs, st.lists(seeds, max_size=4), st.integers(1, 4), st.none() | st.integers(1, 12))
@examples(40)
def test_collect_episodes_returns_states_at_decisions_and_ends(design, several, size, most):
    found = collect_episodes(
        lambda: Yard(design),
        everywhere(by_row(yard_policy)),
        points=YARD_POINTS,
        seeds=several,
        batch_size=size,
        max_steps=most,
        state_space=SPACE,
    )
    for each in found.values():
        assert each.states.dtype == each.next_states.dtype == np.float32
        assert each.states.shape == each.next_states.shape == (len(each), 2)
        assert each.last_states.shape == (len(each.starts), 2)
        # The models' observations have the same number, as of the same moment.
        assert each.states[:, 0].tolist() == each.observations[:, 2].tolist()
        assert each.next_states[:, 0].tolist() == each.next_observations[:, 2].tolist()
        assert each.last_states[:, 0].tolist() == each.last_observations[:, 2].tolist()
        if len(each):
            assert each.states[:, 1].tolist() == each.times.tolist()
            assert each.next_states[:, 1].tolist() == (each.times + each.elapsed).tolist()


@given(yard_designs, st.lists(seeds, max_size=3), st.sampled_from(["all", "machines", "names"]))
@examples(20)
def test_collect_episodes_states_of_observations_match_aec_env(design, several, whose):
    options = {
        "points": YARD_POINTS,
        "max_steps": 12,
        "possible_agents": YARD_ROSTER,
        "state_space": "observations",
    }
    keys = [*(key for key in YARD_POINTS if key != PLANS), "planner"]
    if whose != "all":
        keys.remove("planner")
    if whose == "names":
        keys = ["load_0", "load_1", "pace_1"]
    found = collect_episodes(
        lambda: Yard(design), dict.fromkeys(keys, by_row(yard_policy)), seeds=several, **options
    )
    others = {} if whose == "all" else {"planner": RULE}
    if whose == "names":
        others |= {
            name: RULE for names in YARD_ROSTER.values() for name in names if name not in keys
        }
    env = aec_env(lambda: Yard(design), policies=others, **options)
    expected = {}
    for number, seed in enumerate(several):

        def answer(agent, env, number=number):
            observation, *_, info = env.last()
            expected[number, agent, info["time"], observation[2]] = env.state()
            return yard_policy(observation)

        with suppress(NoDecisionError):
            list(play(env, answer, seed=seed))
    for each in found.values():
        agents = [each.names[agent] for agent in each.agents]
        for row, state in enumerate(each.states):
            key = each.episodes[row], agents[row], each.times[row], each.observations[row, 2]
            assert state.tolist() == expected[key].tolist()


def test_simulation_state_is_not_called_if_nothing_uses_it():
    class Silent(Yard):
        def state(self):
            raise AssertionError

    given = {"points": YARD_POINTS, "seeds": range(3)}
    policies = everywhere(by_row(yard_policy))
    for each in collect_episodes(lambda: Silent(BUSY), policies, **given).values():
        assert each.states is each.last_states is each.next_states is None
    simulate_many(lambda: Silent(BUSY), policies, state_space=SPACE, **given)
    evaluate(lambda: Silent(BUSY), {"a": policies}, batched=True, state_space=SPACE, **given)


def test_collect_episodes_with_workers_returns_the_same_states():
    policies = {PLANS: RULE, f"{HERE}.Machine.load": checking, f"{HERE}.Machine.pace": checking}
    alone, one, two = (
        collect_episodes(
            busy, policies, points=YARD_POINTS, seeds=range(7), batch_size=2, workers=n
        )
        for n in (0, 1, 2)
    )
    for key, found in alone.items():
        for other in (one[key], two[key]):
            assert np.array_equal(found.states, other.states)
            assert np.array_equal(found.next_states, other.next_states)
        if key != PLANS:
            assert np.array_equal(found.states, found.extras["seen"])
    many = [
        simulate_many(
            busy, policies, points=YARD_POINTS, seeds=range(7), workers=n, collect=yard_outcome
        )
        for n in (0, 1)
    ]
    assert many[0] == many[1]


def test_collect_episodes_records_last_states_with_plugins_and_each_driver():
    attach_handler(lambda state: state, f"{HERE}.Yard.plan", "after")
    try:
        for driver in ("greenlet", "thread"):
            found = collect_episodes(
                busy,
                everywhere(by_row(yard_policy)),
                points=YARD_POINTS,
                seeds=range(3),
                driver=driver,
                global_rng=True,
                state_in_info=True,
            )
            load = found[f"{HERE}.Machine.load"]
            assert load.terminations.any()
            assert load.next_states[:, 0].tolist() == load.next_observations[:, 2].tolist()
    finally:
        remove_handler(f"{HERE}.Yard.plan", "after")


def test_record_dataset_contains_states(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    policies = {"planner": by_row(lambda observation: 2)}
    given = {"points": YARD_PLAN, "seeds": range(3), "state_space": SPACE}
    dataset = record_dataset("yard/plans-v0", busy, policies, **given)
    found = collect_episodes(busy, policies, **given)["planner"]
    for number, start in enumerate(found.starts):
        states = dataset[number].infos["state"]
        rows = slice(start, start + found.lengths[number])
        assert states[:-1].tolist() == found.states[rows].tolist()
        assert states[-1].tolist() == found.last_states[number].tolist()


# -- policies -------------------------------------------------------------------------------------


def traces(policies, **options):
    return simulate_many(
        busy, policies, points=YARD_POINTS, seeds=range(5), collect=yard_outcome, **options
    )


def test_batched_policies_get_stacked_simulation_states():
    expected = traces(everywhere(by_row(yard_policy)))

    def third(observations, infos, identities, *, _state):
        assert len(identities) == len(_state)
        return checking(observations, infos, _state=_state)

    def first(observations, *, _state):
        assert _state[:, 0].tolist() == observations[:, 2].tolist()
        return list(map(yard_policy, observations))

    for policy in (checking, third, first):
        assert traces(everywhere(policy)) == expected
        assert traces(everywhere(policy), driver="thread", batch_size=2) == expected
    found = evaluate(
        busy,
        {"states": everywhere(checking), "plain": everywhere(first)},
        seeds=range(4),
        points=YARD_POINTS,
        batched=True,
    )
    values = found.values("return")
    assert values["states"].tolist() == values["plain"].tolist()


def test_policies_get_the_simulation_state_of_their_decision():
    async def waiting(observation, info, *, _state):
        await asyncio.sleep(0)
        return checking_one(observation, info, _state=_state)

    def described(observation, info, *, _decision, _state):
        assert _state[1] == _decision.time
        return checking_one(observation, info, _state=_state)

    plain = everywhere(yard_policy)
    expected = yard_outcome(simulate(busy, plain, points=YARD_POINTS, seed=3))
    for policy in (checking_one, waiting, described):
        policies = everywhere(policy)
        assert yard_outcome(simulate(busy, policies, points=YARD_POINTS, seed=3)) == expected
    for policy in (waiting, described):
        assert traces(everywhere(policy))[3] == expected
        found = collect_episodes(busy, everywhere(policy), points=YARD_POINTS, seeds=range(2))[
            PLANS
        ]
        assert found.states[:, 0].tolist() == found.observations[:, 2].tolist()
    machines = {key: checking_one for key in YARD_POINTS if key != PLANS}
    for driver in ("greenlet", "thread"):
        env = aec_env(busy, YARD_POINTS, policies=machines, driver=driver)
        list(play(env, lambda agent, env: yard_policy(env.last()[0]), seed=3))
        assert yard_outcome(env.simulation) == expected
        env.close()
    found = evaluate(
        busy,
        {"states": everywhere(checking_one), "plain": plain},
        seeds=range(3),
        points=YARD_POINTS,
    )
    values = found.values("return")
    assert values["states"].tolist() == values["plain"].tolist()


def test_policies_in_branches_get_the_simulation_state_of_their_branch():
    seen = []

    def trying(observation, *, _environment):
        seen.append(branch(_environment, look))
        return yard_policy(observation)

    def look(env, number):
        env.step(1)
        return env.state().tolist()

    machines = {key: checking for key in YARD_POINTS if key != PLANS}
    expected = traces(everywhere(by_row(yard_policy)))
    assert traces({**machines, PLANS: trying}) == expected
    assert len(seen) > 5


def test_mixture_and_compare_with_rule_pass_simulation_states_to_policies():
    def two(observations, *, _state):
        assert _state[:, 0].tolist() == observations[:, 2].tolist()
        return np.full(len(observations), 2)

    mixture = Mixture({checking: 0.5, two: 0.3, RULE: 0.2})
    found = collect_episodes(busy, {"planner": mixture}, points=YARD_POINTS, seeds=range(6))[
        "planner"
    ]
    assert set(found.extras["component"]) == {0, 1, 2}
    assert found.states[:, 1].tolist() == found.times.tolist()
    compared = compare_with_rule(
        busy,
        {"planner": checking},
        points={PLANS: replace(YARD_POINTS[PLANS], rule_action_mapping=int)},
        seeds=range(4),
    )["planner"]
    assert compared.trajectories.by_rule.all()
    assert compared.trajectories.states is not None
    assert Mixture({two: 1}).takes_state
    assert not Mixture({by_row(yard_policy): 1}).takes_state


def test_turn_and_joint_policies_get_the_simulation_state():
    env = turn_env(busy, YARD_POINTS)

    def one(observation, info, *, _state):
        return checking_one(observation["observation"], info, _state=_state)

    def many(observations, info, *, _state):
        assert _state[:, 0].tolist() == observations["observation"][:, 2].tolist()
        return np.full(len(_state), 3)

    expected = traces(everywhere(by_row(yard_policy)))
    assert traces(turn_policy(one, like=env)) == expected
    constant = traces(everywhere(by_row(lambda observation: 3)))
    assert traces(turn_policy(many, like=env, batched=True)) == constant

    joint = joint_env(busy, YARD_PLAN)
    seen = []

    def together(observation, info, *, _state):
        seen.append(_state[0] == observation["planner"][2])
        return {"planner": 2}

    simulate(busy, joint_policy(together, like=joint), points=YARD_PLAN, seed=1)
    assert seen
    assert all(seen)

    def planning(observation, *, _environment):
        return 0

    with pytest.raises(OptionValueError, match="_state alone"):
        turn_policy(planning, like=env)
    with pytest.raises(OptionValueError, match="SimulationJointEnv"):
        joint_policy(one, like=env)


# -- refusals -------------------------------------------------------------------------------------


def test_collect_episodes_states_of_observations_need_possible_agents():
    policies = everywhere(by_row(yard_policy))
    given = {"points": YARD_POINTS, "seeds": range(2), "state_space": "observations"}
    with pytest.raises(OptionValueError, match="possible_agents="):
        collect_episodes(busy, policies, **given)
    with pytest.raises(OptionValueError, match="possible_agents="):
        simulate_many(busy, everywhere(checking), **given)
    few = {point: names[:1] for point, names in YARD_ROSTER.items()}
    with pytest.raises(AgentError, match="possible_agents= lacks 'load_"):
        collect_episodes(busy, policies, possible_agents=few, **given)
    named = {"planner": by_row(yard_policy)}
    found = collect_episodes(busy, named, **(given | {"points": YARD_PLAN}))["planner"]
    assert found.states.tolist() == found.observations.tolist()
    assert collect_episodes(busy, policies, **given, possible_agents=YARD_ROSTER)


def test_collect_episodes_refuses_states_that_cannot_be_stacked():
    class Growing(Yard):
        def state(self):
            return self.trace and [0.0] * (1 + len(self.trace))

    policies = everywhere(by_row(yard_policy))
    given = {"points": YARD_POINTS, "seeds": range(3)}
    for workers in (0, 1):
        with pytest.raises(ObservationError, match="same shape"):
            collect_episodes(
                lambda: Growing(BUSY), policies, state_in_info=True, workers=workers, **given
            )
    with pytest.raises(ObservationError, match="shape"):
        collect_episodes(lambda: Growing(BUSY), policies, state_space=SPACE, **given)
    ant = decision(agent="ant_0")
    with pytest.raises(NotImplementedError, match=r"no method state\(\)") as caught:
        collect_episodes(
            calling(ant),
            {"ant_0": by_row(lambda seen: 1)},
            seeds=[4],
            points=ant,
            state_in_info=True,
        )
    assert "seed 4" in "".join(caught.value.__notes__)
