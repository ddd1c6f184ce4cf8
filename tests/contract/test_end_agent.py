"""Agents whose episode the simulation itself says to be over."""

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    SimulationInterface,
    aec_env,
    make_step,
    parallel_env,
    simulate,
    single_env,
)
from simenv_marl.errors import AgentError

MOVE = f"{__name__}.Seat.move"


class Seat:
    """A place at a table."""

    def __init__(self, name):
        self.name, self.points = name, 0

    def move(self):
        return 1


class Table(SimulationInterface):
    """Three seats; one is out after the first round, without any call that could be named."""

    out = "seat_1"

    def reset(self):
        self.seats = [Seat(f"seat_{number}") for number in range(3)]

    def run(self):
        for number in range(3):
            for seat in self.seats:
                seat.points += seat.move()
            if number == 0:
                self.end_agent(self.out)
                self.seats = [seat for seat in self.seats if seat.name != self.out]


def points(**changes):
    given = {
        "observation_space": spaces.Box(0, 100, (1,), np.float64),
        "observation_space_mapping": lambda seat: [seat.points],
        "action_space": spaces.Discrete(5),
        "action_space_mapping": lambda action: action,
        "reward_mapping": lambda seat: seat.points,
        "agent": lambda seat: seat.name,
    }
    return {MOVE: make_step(**given | changes)}


def told(env, action=2):
    env.reset()
    seen = []
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, _ = env.last()
        seen.append((agent, observation.item(), reward, terminated))
        env.step(None if terminated or truncated else action)
    return seen


def test_it_is_rewarded_and_observed_for_the_last_time_and_leaves() -> None:
    assert told(aec_env(Table, points())) == [
        ("seat_0", 0, 0, False),
        ("seat_1", 0, 0, False),
        ("seat_2", 0, 0, False),
        ("seat_1", 2, 2, True),
        ("seat_0", 2, 2, False),
        ("seat_2", 2, 2, False),
        ("seat_0", 4, 4, False),
        ("seat_2", 4, 4, False),
        ("seat_0", 6, 6, True),
        ("seat_2", 6, 6, True),
    ]


def test_in_rounds_it_ends_in_the_round_in_which_it_is_out() -> None:
    env = parallel_env(Table, points(), possible_agents=[f"seat_{number}" for number in range(3)])
    env.reset()
    _, rewards, terminations, _, _ = env.step(dict.fromkeys(env.agents, 3))
    assert rewards == {"seat_0": 3, "seat_1": 3, "seat_2": 3}
    assert terminations == {"seat_0": False, "seat_1": True, "seat_2": False}
    assert env.agents == ["seat_0", "seat_2"]


def test_the_single_view_ends_with_its_agent() -> None:
    env = single_env(Table, points(), agent="seat_1")
    env.reset()
    assert env.step(4)[1:4] == (4.0, True, False)


def test_by_keyword_and_through_a_method_of_its_own() -> None:
    class Named(Table):
        def end_agent(self, name):
            self.said = name
            super().end_agent(name=name)

    env = aec_env(Named, points())
    assert [agent for agent, *_, terminated in told(env) if terminated] == ["seat_1", "seat_0", "seat_2"]
    assert env.unwrapped.simulation.said == "seat_1"


@pytest.mark.parametrize("out", ["seat_7", None, 3])
def test_what_is_no_live_agent_is_left_alone(out) -> None:
    class Other(Table):
        pass

    Other.out = out
    assert [agent for agent, *_, terminated in told(aec_env(Other, points())) if terminated] == [
        "seat_0", "seat_1", "seat_2",
    ]  # fmt: skip


def test_outside_an_environment_it_does_nothing() -> None:
    table = Table()
    table.reset()
    table.run()
    assert [seat.points for seat in table.seats] == [3, 3]
    assert [seat.points for seat in simulate(Table, points=points()).seats] == [3, 3]
    environments = aec_env(Table, points())
    told(environments)
    assert [seat.points for seat in environments.unwrapped.simulation.seats] == [6, 6]
    table.reset()
    table.run()  # while an environment is in use, too
    assert [seat.points for seat in table.seats] == [3, 3]


def test_to_decide_after_it_is_an_error() -> None:
    class Undead(Table):
        def run(self):
            self.end_agent("seat_0")
            for seat in self.seats:
                seat.move()
                self.end_agent(seat.name)
            self.seats[0].move()

    env = aec_env(Undead, points())
    env.reset()
    env.step(RULE)
    env.step(None)
    env.step(RULE)
    env.step(None)
    with pytest.raises(AgentError, match="after its end"):
        env.step(RULE)


def test_an_agent_with_a_name_of_its_own_can_end_so() -> None:
    class Alone(Table):
        out = "one"

        def run(self):
            self.seats[0].move()
            self.end_agent("one")

    env = single_env(Alone, points(agent="one"))
    env.reset()
    assert env.step(1)[2:4] == (True, False)
