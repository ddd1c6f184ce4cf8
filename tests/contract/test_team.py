"""One reward for the team, in all views."""

import pytest
from hypothesis import given

from simenv_marl import (
    RULE,
    aec_env,
    clone,
    difference,
    generate_env,
    joint_env,
    parallel_env,
    single_env,
    turn_env,
)
from simenv_marl.errors import OptionValueError, RewardError
from tests.extent import examples
from tests.worlds.models import calling, decision, define, play, script
from tests.worlds.random_worlds import YARD_POINTS, YARD_ROSTER, Yard, seeds, yard_designs

CLOSE = {"rel": 1e-9, "abs": 1e-6}


class Counter:
    """A team's reward: the number of times that it was asked, and its values."""

    def __init__(self, *values):
        self.values = list(values)
        self.asked = 0

    def __call__(self, simulation):
        self.asked += 1
        return self.values[self.asked - 1] if self.values else 1.0


def agents(number=2):
    """Decision functions of agents, whose own rewards must not count."""
    return [
        decision(agent=f"{name}_0", reward_mapping=lambda: 1 / 0)
        for name in ("ant", "bee", "cat")[:number]
    ]


# -- who gets what --------------------------------------------------------------------------------


def test_team_reward_of_an_agent_counts_since_its_last_decision():
    ant, bee = agents()
    team = Counter(100, 1, 2, 4, 8)
    env = aec_env(calling(ant, bee, bee, ant), [ant, bee], team_reward=team)
    turns = play(env, 1)
    rewards = [(turn.agent, turn.reward) for turn in turns]
    assert rewards == [
        ("ant_0", 0.0),
        ("bee_0", 0.0),
        ("bee_0", 2.0),
        ("ant_0", 7.0),
        ("ant_0", 8.0),
        ("bee_0", 12.0),
    ]
    assert team.asked == 5  # not at the None steps


def test_turn_env_and_single_env_pay_the_team_reward_once():
    for make in (turn_env, single_env):
        ant, bee = agents()
        policies = {"bee_0": lambda observation: 1} if make is single_env else None
        env = make(
            calling(ant, bee, ant),
            [ant, bee],
            team_reward=Counter(100, 1, 2, 4),
            policies=policies,
        )
        env.reset()
        rewards = [env.step(1)[1] for _ in range(3 if make is turn_env else 2)]
        assert rewards == ([1.0, 2.0, 4.0] if make is turn_env else [1.0, 2.0])


def test_parallel_env_pays_the_team_reward_to_each_live_agent():
    ant, bee = agents()
    env = parallel_env(calling(ant, bee, ant, bee), [ant, bee], team_reward=Counter(100, 1, 2))
    env.reset()
    assert env.step({"ant_0": 1, "bee_0": 1})[1] == {"ant_0": 1.0, "bee_0": 1.0}
    assert env.step({"ant_0": 1, "bee_0": 1})[1] == {"ant_0": 2.0, "bee_0": 2.0}
    env = joint_env(calling(ant, bee, ant, bee), [ant, bee], team_reward=Counter(100, 1, 2))
    env.reset()
    assert [env.step({"ant_0": 1, "bee_0": 1})[1] for _ in range(2)] == [1.0, 2.0]


def test_split_items_earn_the_team_reward():
    bid = define(split=lambda items: items, agent=lambda item: item)(lambda items: items)
    env = turn_env(
        script(lambda simulation: bid(["ant", "bee"])), bid, team_reward=Counter(100, 1, 2)
    )
    env.reset()
    assert [env.step(0)[1] for _ in range(2)] == [1.0, 2.0]


def test_team_reward_that_is_no_number_is_refused():
    ant, _ = agents()
    env = aec_env(calling(ant), [ant], team_reward=lambda simulation: None)
    with pytest.raises(RewardError, match="is not one number"):
        env.reset()
    with pytest.raises(OptionValueError, match="a callable of the simulation"):
        aec_env(calling(ant), [ant], team_reward=1.0)


# -- what adds up to what -------------------------------------------------------------------------


def earned(yard):
    """What a yard has earned in all, with births and deaths."""
    return yard.fortune + 10.0 * yard.built


@given(yard_designs, seeds)
@examples(60)
def test_team_rewards_add_up_from_the_first_decision_to_the_end(design, seed):
    options = {
        "possible_agents": YARD_ROSTER,
        "team_reward": difference(earned),
    }
    for view in ("turn", "joint"):
        env = generate_env(lambda: Yard(design), YARD_POINTS, view=view, **options)()
        env.reset(seed=seed)
        before = earned(env.simulation)
        total, ended = 0.0, False
        while not ended:
            _, reward, terminated, truncated, _ = env.step(RULE)
            total += reward
            ended = terminated or truncated
        assert total == pytest.approx(earned(env.simulation) - before, **CLOSE)
        env.close()
    aec = aec_env(lambda: Yard(design), YARD_POINTS, **options)
    begins = {}
    totals = {}
    ends = {}
    aec.reset(seed=seed)
    while aec.agents:
        agent = aec.agent_selection
        _, reward, terminated, truncated, _ = aec.last()
        ended = terminated or truncated
        now = earned(aec.simulation)
        if not ended:
            begins.setdefault(agent, now)
        totals[agent] = totals.get(agent, 0.0) + reward
        if ended:
            ends[agent] = now  # at the return of the step in which it ended
        aec.step(None if ended else RULE)
    for agent, begin in begins.items():
        assert totals[agent] == pytest.approx(ends[agent] - begin, **CLOSE)
    assert all(totals[agent] == 0.0 for agent in totals.keys() - begins.keys())
    aec.close()


@given(yard_designs, seeds)
@examples(30)
def test_parallel_env_agents_get_the_team_reward_since_they_joined(design, seed):
    env = parallel_env(
        lambda: Yard(design),
        YARD_POINTS,
        possible_agents=YARD_ROSTER,
        team_reward=difference(earned),
    )
    env.reset(seed=seed)
    episode = env.session.episode
    now = earned(env.simulation)
    # The total when the round of each agent's first decision began.
    joined = {episode.pending.name: now}
    totals = {}
    while env.agents:
        before = now
        _, rewards, terminations, truncations, infos = env.step(RULE)
        now = earned(env.simulation)
        for agent, reward in rewards.items():
            if episode.agent(agent).decided:
                joined.setdefault(agent, before if infos[agent]["acted"] else now)
            totals[agent] = totals.get(agent, 0.0) + reward
            if terminations[agent] or truncations[agent]:
                due = now - joined.get(agent, now)
                assert totals[agent] == pytest.approx(due, **CLOSE)
    env.close()


def test_clone_continues_the_team_reward():
    ant, bee = agents()

    def main(simulation):
        simulation.level = 0
        for step in range(4):
            simulation.level += step + ant()
            simulation.level += bee()

    team = difference(lambda simulation: simulation.level)
    for make in (turn_env, aec_env, joint_env):
        env = make(script(main), [ant, bee], team_reward=team)
        env.reset(seed=1)
        env.step({"ant_0": 2, "bee_0": 1} if make is joint_env else 2)
        twins = [clone(env), clone(env, method="replay")]
        rewards = rest(env)
        assert sum(rewards) > 0
        for twin in twins:
            assert rest(twin) == pytest.approx(rewards)
            twin.close()
        env.close()


def rest(env):
    """The rewards of the rest of an episode that follows the rule with 3."""
    rewards = []
    if hasattr(env, "agents"):
        return [turn.reward for turn in play(env, 3, reset=False)]
    ended = False
    while not ended:
        is_joint = hasattr(env, "joint")
        _, reward, terminated, truncated, _ = env.step({"ant_0": 3, "bee_0": 3} if is_joint else 3)
        rewards.append(reward)
        ended = terminated or truncated
    return rewards
