"""``max_steps``, where no agent can decide any more and the model goes on."""

import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    SimulationInterface,
    aec_env,
    joint_env,
    parallel_env,
    single_env,
)
from tests.worlds.models import begun, calling, decision, define, play

GRAZE = f"{__name__}.Sheep.graze"
SHEEP = ["sheep_0", "sheep_1"]


class Sheep:
    def __init__(self, meadow, number):
        self.meadow = meadow
        self.name = f"sheep_{number}"

    def graze(self):
        return 0

    def die(self):
        self.meadow.living.remove(self)


class Meadow(SimulationInterface):
    """Its last sheep die in the third year. It goes on for years without any."""

    by_name = False

    def reset(self, seed=None):
        self.living = [Sheep(self, number) for number in range(2)]
        self.years = 0

    def expected_calls(self, point):
        return [(sheep,) for sheep in self.living]

    def run(self):
        while self.years < 1000:
            self.years += 1
            for sheep in self.living:
                sheep.graze()
            if self.years == 3:
                for sheep in list(self.living):
                    if self.by_name:
                        self.end_agent(sheep.name)
                    sheep.die()


class Named(Meadow):
    by_name = True


def flock(**changes):
    return {GRAZE: define(agent=lambda sheep: sheep.name, reward_mapping=lambda _: 1.0, **changes)}


POINTS = {
    Meadow: flock(removed_by=[f"{__name__}.Sheep.die"]),
    Named: flock(),
}


def steps_of(env):
    """Play an episode of any view; return the number of its steps."""
    if hasattr(env, "agent_iter"):
        return len(play(env, 1))
    env.reset()
    steps = 0
    over = False
    while not over:
        steps += 1
        if hasattr(env, "possible_agents"):
            env.step(dict.fromkeys(env.agents, 1))
            over = not env.agents
            continue
        action = 1 if isinstance(env.action_space, spaces.Discrete) else dict.fromkeys(SHEEP, 1)
        *_, terminated, truncated, _ = env.step(action)
        assert not truncated
        over = terminated
    return steps


@pytest.mark.parametrize("kind", POINTS)
@pytest.mark.parametrize(
    ("view", "options", "steps"),
    [
        (aec_env, {"possible_agents": SHEEP}, 8),
        (parallel_env, {"possible_agents": SHEEP}, 3),
        (joint_env, {"possible_agents": SHEEP}, 3),
        (single_env, {"agent": "sheep_0"}, 3),
    ],
)
def test_episode_ends_when_all_possible_agents_have_ended(view, options, steps, kind):
    env = view(kind, POINTS[kind], max_steps=500, **options)
    for _ in range(2):
        assert steps_of(env) == steps
        assert env.simulation.years == 3
    env.close()


def test_single_env_runs_the_models_removal_before_the_episode_ends():
    env = single_env(Meadow, POINTS[Meadow], agent="sheep_1", max_steps=500)
    steps_of(env)
    assert "sheep_1" not in [sheep.name for sheep in env.simulation.living]


def test_parallel_env_without_max_steps_runs_the_simulation_to_its_end():
    env = parallel_env(Meadow, POINTS[Meadow], possible_agents=SHEEP)
    steps_of(env)
    assert env.simulation.years == 1000


def test_info_has_no_rule_action_if_apply_itself_calls_the_rule():
    fill = decision(lambda: 3, apply=lambda action: fill() + action, rule_action_mapping=int)
    env = begun(single_env(calling(*[fill] * 4), fill))
    infos = [env.step(action)[4] for action in (1, RULE, 2)]
    assert env.simulation.log == [4, 3, 5]
    assert infos == [{}, {"rule_action": 3}, {}]
