"""Mesa's own example models, unmodified: births and deaths in the hundreds, addressed by names from outside.

They are made and run in other ways since Mesa 3.5, which is nobody's business beyond the section that makes them.
"""

import gc
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from mesa.examples.advanced.pd_grid.model import PdGrid
from mesa.examples.advanced.wolf_sheep import model as wolf_sheep
from mesa.examples.advanced.wolf_sheep.agents import GrassPatch, Sheep, Wolf
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from simenv_marl import (
    RULE,
    TRUNCATED,
    aec_env,
    difference,
    joint_env,
    make_step,
    parallel_env,
    simulate,
)
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


def dilemma(width, order, seed):
    return PdGrid(width, width, activation_order=order, **{"rng" if SCENARIOS else "seed": seed})


def advances_in_its_step(prisoner):
    """Whether the rule carries out what it has decided; else the model has it done."""
    return not SCENARIOS and prisoner.model.activation_order != "Simultaneous"


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


class AnnouncedMeadow(Meadow, AnnouncedPasture):
    pass


def go(action, animal):
    cells = list(animal.cell.neighborhood)
    animal.cell = cells[action % len(cells)]


def energy(animal):
    assert animal.cell is not None, "an animal that is gone is not to be looked at"
    return animal.energy


def animals(kind, **changes):
    return make_step(
        **{
            "observation_space": spaces.Box(-1e3, 1e3, (3,), np.float32),
            "observation_space_mapping": lambda animal: [energy(animal), *animal.cell.coordinate],
            "action_space": spaces.Discrete(4),
            "apply": go,
            "reward_mapping": energy,
            "agent": lambda animal: f"{kind}_{animal.unique_id}",
            "removed_by": "mesa.agent.Agent.remove",
        }
        | changes
    )


def herd(**changes):
    return {
        f"{EXAMPLES}.wolf_sheep.agents.Wolf.move": animals("wolf", **changes),
        f"{EXAMPLES}.wolf_sheep.agents.Sheep.move": animals("sheep", **changes),
    }


# -- prisoners ------------------------------------------------------------------------------------


class Prison:
    """PdGrid for some ticks, of 400 agents."""

    ticks, width, order = 6, 20, "Random"

    def reset(self, seed=None):
        self.model = dilemma(self.width, self.order, seed)
        self.states = [self.state_of_everything()]

    def run(self):
        for _ in range(self.ticks):
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


class AnnouncedPrison(Prison):
    def expected_calls(self, point):
        return [(prisoner,) for prisoner in self.model.agents]


class Cell(AnnouncedPrison):
    """A small one."""

    ticks, width = 4, 5


def play_dilemma(action, prisoner):
    prisoner.next_move = "CD"[action]
    if advances_in_its_step(prisoner):
        prisoner.advance()


def prisoners(**changes):
    definition = make_step(
        **{
            "observation_space": spaces.Box(0, 1e4, (3,), np.float32),
            "observation_space_mapping": lambda prisoner: [
                prisoner.score,
                1 + prisoner.is_cooroperating,
                sum(other.is_cooroperating for other in prisoner.cell.neighborhood.agents),
            ],
            "action_space": spaces.Discrete(2),
            "apply": play_dilemma,
            "reward_mapping": difference(lambda prisoner: prisoner.score),
            "agent": lambda prisoner: f"prisoner_{prisoner.unique_id}",
        }
        | changes
    )
    return {f"{EXAMPLES}.pd_grid.agents.PDAgent.step": definition}


def roster(width):
    return [f"prisoner_{number}" for number in range(1, width * width + 1)]


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
    assert all_alike(simulate(Prison, points=prisoners(), seed=3).states, plain.states)
    assert all_alike(follow_the_rule(aec_env(Prison, prisoners()), 3).states, plain.states)
    for simulation, options in ((AnnouncedPrison, {}), (Prison, {"possible_agents": roster(20)})):
        env = parallel_env(simulation, prisoners(), **options)
        assert in_rounds(env, 3) == (Prison.ticks, 0)
        assert all_alike(env.simulation.states, plain.states)
    env = joint_env(AnnouncedPrison, prisoners())
    assert set(env.action_space.spaces) == set(roster(20))
    env.reset(seed=3)
    told = [env.step(RULE) for _ in range(Prison.ticks)]
    assert [step[2:4] for step in told] == [(False, False)] * (Prison.ticks - 1) + [(False, True)]
    assert all(all(info["acted"].values()) for *_, info in told)
    assert all_alike(env.simulation.states, plain.states)
    # Each prisoner is paid what it has won since it was known, which is since the beginning.
    won = sum(score for *_, score, _ in plain.states[-1][0])
    assert sum(step[1] for step in told) == pytest.approx(won)


# -- births and deaths ----------------------------------------------------------------------------


def ids_in(state):
    """Who lives."""
    return {unique_id for unique_id, *_ in state[0]}


def ids_of(agents):
    return {int(agent.partition("_")[2]) for agent in agents}


def test_deaths_in_rounds():
    env = parallel_env(AnnouncedPasture, herd())
    env.reset(seed=5)
    ended = {}
    for tick in range(1, Pasture.ticks + 1):
        before = ids_in(env.simulation.states[-1])
        assert ids_of(env.agents) == before
        observations, rewards, terminations, truncations, infos = env.step(dict.fromkeys(env.agents, RULE))
        after = ids_in(env.simulation.states[tick])
        assert ids_of(agent for agent, end in terminations.items() if end) == before - after
        cut = after & before if tick == Pasture.ticks else set()
        assert ids_of(agent for agent, end in truncations.items() if end) == cut
        assert ids_of(observations) >= before
        assert set(observations) == set(rewards) == set(infos)
        assert ended.keys().isdisjoint(terminations)
        ended.update({agent: observations[agent] for agent, end in terminations.items() if end})
        energies = {unique_id: energy for unique_id, energy, _ in env.simulation.states[tick][0]}
        for agent, observation in observations.items():
            (unique_id,) = ids_of([agent])
            if unique_id in energies:
                # Its energy at the end of the tick: the first of the next one only stands there and decides.
                assert observation[0] == np.float32(energies[unique_id])
                assert infos[agent]["time"] == (tick if tick == Pasture.ticks else tick + 1)
    assert env.agents == []
    sheep = [observation for agent, observation in ended.items() if agent.startswith("sheep")]
    assert any(observation[0] >= 0 for observation in sheep)  # eaten: not all have starved
    assert all(observation[0] >= -1 for observation in ended.values())


def test_the_environment_keeps_no_animal():
    """The model counts on whoever is removed being gone."""
    env = aec_env(Pasture, herd())
    env.reset(seed=5)
    for agent in env.agent_iter():
        if env.simulation.model.steps > 10:
            break
        env.step(None if env.terminations[agent] else RULE)
    model = env.simulation.model
    gc.collect()
    living = {id(animal) for kind in (Wolf, Sheep) for animal in model.agents_by_type[kind]}
    there = [thing for thing in gc.get_objects() if type(thing) in (Wolf, Sheep) and thing.model is model]
    assert {id(animal) for animal in there} == living
    env.close()


# -- PettingZoo's and Gymnasium's tests -----------------------------------------------------------

UNKNOWN_ROSTER = r"This environment does not have possible_agents defined\."


@pytest.mark.parametrize("simulation", [Meadow, AnnouncedMeadow])
@pytest.mark.filterwarnings(f"ignore:{UNKNOWN_ROSTER}", "ignore:No agents present")  # at the end of each episode
def test_pettingzoos_tests_of_wolves_and_sheep(simulation):
    with pytest.warns(UserWarning, match=UNKNOWN_ROSTER) as caught:
        api_test(aec_env(simulation, herd()), num_cycles=20)
    assert len(caught) == 1
    seed_test(lambda: aec_env(simulation, herd()), num_cycles=20)
    parallel_seed_test(lambda: parallel_env(simulation, herd()), num_cycles=20)
    parallel_api_test(parallel_env(simulation, herd()), num_cycles=50)


def test_pettingzoos_and_gymnasiums_tests_of_prisoners():
    aec, parallel = (partial(make, Cell, prisoners(), possible_agents=roster(5)) for make in (aec_env, parallel_env))
    api_test(aec(), num_cycles=2)
    seed_test(aec, num_cycles=2)
    parallel_api_test(parallel(), num_cycles=20)
    parallel_seed_test(parallel, num_cycles=20)
    check_env(joint_env(Cell, prisoners()), skip_render_check=True)
