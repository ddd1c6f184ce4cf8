"""Agents whose episode the simulation itself says to be over."""

import pytest

from simenv_marl import RULE, SimulationInterface, aec_env, parallel_env, simulate, single_env
from simenv_marl.errors import AgentError, UnknownAgentError
from tests.worlds.models import define, play


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


def points(agent=lambda seat: seat.name):
    return {
        f"{__name__}.Seat.move": define(
            agent=agent,
            observation_space_mapping=lambda seat: [seat.points, 0],
            reward_mapping=lambda seat: seat.points,
        )
    }


def told(env):
    return [(turn.agent, turn.observation[0], turn.reward, turn.terminated) for turn in play(env, 2)]


def test_the_agent_is_rewarded_and_observed_for_the_last_time_and_leaves():
    class Named(Table):
        def end_agent(self, name):
            self.said = name
            super().end_agent(name=name)

    env = aec_env(Named, points())
    assert told(env) == [
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
    assert env.simulation.said == "seat_1"


@pytest.mark.parametrize("out", ["seat_7", None, 3])
def test_names_of_no_live_agent_are_left_alone(out):
    other = type("Other", (Table,), {"out": out})
    ends = [agent for agent, *_, terminated in told(aec_env(other, points())) if terminated]
    assert ends == ["seat_0", "seat_1", "seat_2"]


@pytest.mark.parametrize("early", [False, True])
def test_in_rounds_an_agent_ends_in_the_round_in_which_it_is_out_or_else_in_the_first(early):
    class Early(Table):
        def run(self):
            self.end_agent(self.out)
            self.seats = self.seats[::2]
            super().run()

    env = parallel_env(Early if early else Table, points(), possible_agents=[f"seat_{number}" for number in range(3)])
    env.reset()
    _, rewards, terminations, _, _ = env.step(dict.fromkeys(env.agents, 3))
    assert rewards == {"seat_0": 3, "seat_1": 0 if early else 3, "seat_2": 3}
    assert terminations == {"seat_0": False, "seat_1": True, "seat_2": False}
    assert env.agents == ["seat_0", "seat_2"]
    assert set(env.step(dict.fromkeys(env.agents, 3))[0]) == {"seat_0", "seat_2"}
    with pytest.raises(UnknownAgentError, match="seat_1"):
        env.step({"seat_1": 3})


def test_the_single_view_ends_with_its_agent():
    class Alone(Table):
        def run(self):
            self.seats[0].points += self.seats[0].move()
            self.end_agent("one")

    for env in (single_env(Table, points(), agent="seat_1"), single_env(Alone, points("one"))):
        env.reset()
        assert env.step(4)[1:4] == (4.0, True, False)


def test_outside_an_environment_end_agent_does_nothing():
    def is_plain():
        table = Table()
        table.reset()
        table.run()
        return [seat.points for seat in table.seats] == [3, 3]

    assert is_plain()
    assert [seat.points for seat in simulate(Table, points=points()).seats] == [3, 3]
    env = aec_env(Table, points())
    env.reset()
    assert is_plain()  # while an environment is in use, too
    assert told(env)[-1] == ("seat_2", 6, 6, True)


def test_an_agent_that_decides_after_its_end_is_an_error():
    class Undead(Table):
        def run(self):
            self.end_agent("seat_0")
            for seat in self.seats:
                seat.move()
                self.end_agent(seat.name)
            self.seats[0].move()

    env = aec_env(Undead, points())
    env.reset()
    for action in (RULE, None, RULE, None):
        env.step(action)
    with pytest.raises(AgentError, match="after its end"):
        env.step(RULE)
