"""Mesa's own example models, unmodified: births and deaths in the hundreds, addressed by names from outside.

They are made and run in other ways since Mesa 3.5, which is nobody's business beyond the section that makes them.
"""

import numpy as np
import pytest
from gymnasium import spaces
from mesa.examples.advanced.pd_grid.model import PdGrid
from mesa.examples.advanced.wolf_sheep import model as wolf_sheep
from mesa.examples.advanced.wolf_sheep.agents import GrassPatch, Sheep, Wolf

from simenv_marl import RULE, TRUNCATED, aec_env, difference, make_step, parallel_env, simulate
from tests.worlds.models import follow_the_rule

EXAMPLES = "mesa.examples.advanced"

# -- the models of either line of Mesa ------------------------------------------------------------

SCENARIOS = hasattr(wolf_sheep, "WolfSheepScenario")
"""Whether models take scenarios and keep their own time, as from Mesa 3.5 on."""


def wolves_and_sheep(seed, size):
    """Returns WolfSheep, what runs it for a while and knows the time, and what holds the events that are to come."""
    if SCENARIOS:
        model = wolf_sheep.WolfSheep(wolf_sheep.WolfSheepScenario(rng=seed, **size))
        return model, model, model._event_list
    from mesa.experimental.devs import ABMSimulator

    simulator = ABMSimulator()
    return wolf_sheep.WolfSheep(simulator=simulator, seed=seed, **size), simulator, simulator.event_list


# -- wolves and sheep -----------------------------------------------------------------------------


class Pasture:
    """WolfSheep for some ticks, with everything noted that there is to know of it."""

    ticks, size = 25, {}

    def reset(self, seed=None):
        self.model, self.clock, self.event_list = wolves_and_sheep(seed, self.size)
        self.states = [self.state_of_everything()]

    def run(self):
        for _ in range(self.ticks):
            self.clock.run_for(1)
            self.states.append(self.state_of_everything())
        return TRUNCATED

    def time(self):
        return self.clock.time

    def animals(self, kind):
        return self.model.agents_by_type.get(kind, ())

    def events(self):
        """What is to come, in its order: the ids count all events of the process."""
        events = sorted(self.event_list._events, key=lambda event: event.unique_id)
        return [(event.time, event.priority) for event in events]

    def state_of_everything(self):
        model = self.model
        return (
            [(a.unique_id, a.energy, a.cell.coordinate) for kind in (Wolf, Sheep) for a in self.animals(kind)],
            [patch.fully_grown for patch in model.agents_by_type[GrassPatch]],
            {cell.coordinate: [a.unique_id for a in cell.agents] for cell in model.grid},
            self.events(),
            model.random.getstate(),
            model.rng.bit_generator.state,
            [counts[-1] for counts in model.datacollector.model_vars.values()],
        )


class AnnouncedPasture(Pasture):
    def expected_calls(self, point):
        return [(animal,) for animal in self.animals(Wolf if ".Wolf." in point else Sheep)]


class Meadow(Pasture):
    """A small one."""

    ticks, size = 8, {"width": 6, "height": 6, "initial_sheep": 14, "initial_wolves": 6}


def go(action, animal):
    cells = list(animal.cell.neighborhood)
    animal.cell = cells[action % len(cells)]


def energy(animal):
    assert animal.cell is not None, "an animal that is gone is not to be looked at"
    return animal.energy


def animals(kind):
    return make_step(
        observation_space=spaces.Box(-1e3, 1e3, (3,), np.float32),
        observation_space_mapping=lambda animal: [energy(animal), *animal.cell.coordinate],
        action_space=spaces.Discrete(4),
        apply=go,
        reward_mapping=energy,
        agent=lambda animal: f"{kind}_{animal.unique_id}",
        removed_by="mesa.agent.Agent.remove",
    )


def herd():
    return {
        f"{EXAMPLES}.wolf_sheep.agents.Wolf.move": animals("wolf"),
        f"{EXAMPLES}.wolf_sheep.agents.Sheep.move": animals("sheep"),
    }


# -- prisoners ------------------------------------------------------------------------------------


class Prison:
    """PdGrid for some ticks, of 100 agents."""

    order = "Random"

    def reset(self, seed=None):
        self.model = PdGrid(10, 10, activation_order=self.order, **{"rng" if SCENARIOS else "seed": seed})
        self.states = [self.state_of_everything()]

    def run(self):
        for _ in range(6):
            self.model.step()
            self.states.append(self.state_of_everything())
        return TRUNCATED

    def state_of_everything(self):
        model = self.model
        return (
            [(a.unique_id, a.move, a.next_move, a.score, a.cell.coordinate) for a in model.agents],
            model.random.getstate(),
            model.rng.bit_generator.state,
            model.datacollector.model_vars["Cooperating_Agents"][-1],
        )


def play_dilemma(action, prisoner):
    prisoner.next_move = "CD"[action]
    if not SCENARIOS and prisoner.model.activation_order != "Simultaneous":
        prisoner.advance()  # which else the model has done


def prisoners():
    definition = make_step(
        observation_space=spaces.Box(0, 1e4, (2,), np.float32),
        observation_space_mapping=lambda prisoner: [prisoner.score, prisoner.is_cooroperating],
        action_space=spaces.Discrete(2),
        apply=play_dilemma,
        reward_mapping=difference(lambda prisoner: prisoner.score),
        agent=lambda prisoner: f"prisoner_{prisoner.unique_id}",
    )
    return {f"{EXAMPLES}.pd_grid.agents.PDAgent.step": definition}


# -- with RULE throughout -------------------------------------------------------------------------


def plain_run(simulation, seed):
    simulation = simulation()
    simulation.reset(seed)
    simulation.run()
    return simulation


def all_alike(states, others):
    """Whether two runs are the same; says where they differ first."""
    for tick, (state, other) in enumerate(zip(states, others, strict=True)):
        for part, (one, another) in enumerate(zip(state, other, strict=True)):
            assert one == another, f"part {part} at tick {tick}"
    return True


@pytest.mark.parametrize("seed", [5, 11])
def test_wolves_and_sheep_with_rule_throughout_are_the_plain_run(seed):
    plain = plain_run(Pasture, seed)
    assert len({tuple(state[-1]) for state in plain.states}) > 20  # it is a lively run
    assert all_alike(simulate(Pasture, points=herd(), seed=seed).states, plain.states)
    for simulation in (Pasture, AnnouncedPasture):
        assert all_alike(follow_the_rule(aec_env(simulation, herd()), seed).states, plain.states)
        env = parallel_env(simulation, herd())
        rounds, dropped = in_rounds(env, seed)
        assert all_alike(env.simulation.states, plain.states)
        if simulation is AnnouncedPasture:
            assert (rounds, dropped) == (Pasture.ticks, 0)
        else:
            assert rounds > Pasture.ticks  # each birth needs a return


def in_rounds(env, seed):
    """Let the rule decide throughout; return the number of rounds and of actions that were dropped."""
    env.reset(seed=seed)
    rounds = dropped = 0
    while env.agents:
        actions = dict.fromkeys(env.agents, RULE)
        *_, infos = env.step(actions)
        rounds += 1
        dropped += sum(not infos[agent]["acted"] for agent in actions)
    return rounds, dropped


@pytest.mark.parametrize("order", PdGrid.activation_regimes)
def test_prisoners_with_rule_throughout_are_the_plain_run(order, monkeypatch):
    monkeypatch.setattr(Prison, "order", order)
    plain = plain_run(Prison, 3)
    assert all_alike(follow_the_rule(aec_env(Prison, prisoners()), 3).states, plain.states)


# -- births and deaths ----------------------------------------------------------------------------
