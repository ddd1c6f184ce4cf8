"""Mesa's own example models, unchanged, as environments.

Each function below contains the complete definition of one environment.

``python -m examples.mesa_models`` runs each model without an environment and as an AEC environment
with ``RULE`` as every action, and compares the final states of the two models. It then plays random
actions, and prints a table in Markdown. It needs Mesa 3.3 or newer, with its extra ``network``.

From Mesa 3.5 on, some of these models take a scenario. ``stepped`` handles both kinds; a model of
your own needs only ``SteppedSimulation``.
"""

from __future__ import annotations

import argparse
import inspect
import math
import platform
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import mesa
import numpy as np
from gymnasium.spaces import Box, Discrete
from mesa.examples import (
    BoidFlockers,
    BoltzmannWealth,
    ConwaysGameOfLife,
    EpsteinCivilViolence,
    PdGrid,
    Schelling,
    SugarscapeG1mt,
    VirusOnNetwork,
    WolfSheep,
)
from mesa.examples.advanced.alliance_formation.model import MultiLevelAllianceModel

from simenv_marl import RULE, Definition, SteppedSimulation, aec_env, difference, make_step

STEPS: Final = 10
"""The number of steps of an episode."""

Example = tuple[Callable[..., Any], dict[str, Definition], dict[str, Any]]
"""A model, its decision points, and the options of its environments."""


def places(cells: Iterable[Any]) -> dict[int, str]:
    """Return the labels of actions that lead to cells: their coordinates."""
    return {action: str(cell.coordinate) for action, cell in enumerate(cells)}


def boltzmann_wealth() -> Example:
    """A person decides where to go, and gives money away there."""
    move = make_step(
        observation_space=Box(0, np.inf, (2,), np.float32),
        observation_space_mapping=lambda person: [person.wealth, len(person.cell.agents) - 1],
        action_space=Discrete(8),
        choices=lambda person: list(person.cell.neighborhood),
        apply=lambda cell, person: setattr(person, "cell", cell),
        reward_mapping=difference(lambda person: person.wealth),
        agent=lambda person: f"person_{person.unique_id}",
        question="Where do you go, to give money away there?",
        display_mapping=lambda person: {
            "your money": person.wealth,
            "others here": len(person.cell.agents) - 1,
        },
        action_labels=lambda person: places(person.cell.neighborhood),
        observation_labels=["your money", "others here"],
    )
    return (
        BoltzmannWealth,
        {"mesa.examples.basic.boltzmann_wealth_model.agents.MoneyAgent.move": move},
        {},
    )


def schelling() -> Example:
    """A household decides whether to move to another place."""

    def relocate(action: Any, household: Any) -> None:
        if action:
            household.cell = household.model.grid.select_random_empty_cell()

    step = make_step(
        observation_space=Box(0, 8, (3,), np.float32),
        observation_space_mapping=lambda household: [
            household.happy,
            sum(other.type == household.type for other in household.cell.neighborhood.agents),
            sum(not cell.is_empty for cell in household.cell.neighborhood),
        ],
        action_space=Discrete(2),
        apply=relocate,
        reward_mapping=lambda household: float(household.happy),
        agent=lambda household: f"household_{household.unique_id}",
        question="Does the household move to another place?",
        display_mapping=lambda household: {
            "happy": "yes" if household.happy else "no",
            "neighbours": sum(not cell.is_empty for cell in household.cell.neighborhood),
        },
        action_labels=["stay", "move"],
        observation_labels=["happy", "neighbours of its kind", "neighbours"],
    )
    return Schelling, {"mesa.examples.basic.schelling.agents.SchellingAgent.step": step}, {}


def boid_flockers() -> Example:
    """A bird decides by how much to turn."""

    def turn(action: Any, boid: Any) -> None:
        cosine, sine = math.cos(action[0]), math.sin(action[0])
        boid.direction = np.array([[cosine, -sine], [sine, cosine]]) @ boid.direction
        boid.position += boid.direction * boid.speed

    step = make_step(
        observation_space=Box(-np.inf, np.inf, (4,), np.float32),
        observation_space_mapping=lambda boid: [*boid.position, *boid.direction],
        action_space=Box(-0.5, 0.5, (1,), np.float32),
        apply=turn,
        reward_mapping=lambda boid: len(boid.get_neighbors_in_radius(radius=boid.vision)[0]),
        agent=lambda boid: f"boid_{boid.unique_id}",
        question="By how much does the bird turn?",
        display_mapping=lambda boid: {
            "position": f"{boid.position[0]:.1f}, {boid.position[1]:.1f}",
            "direction": f"{boid.direction[0]:.2f}, {boid.direction[1]:.2f}",
        },
        action_labels=["radians"],
        observation_labels=["position x", "position y", "direction x", "direction y"],
    )
    return BoidFlockers, {"mesa.examples.basic.boid_flockers.agents.Boid.step": step}, {}


def conways_game_of_life() -> Example:
    """A cell decides whether it lives on."""
    state = make_step(
        observation_space=Box(0, 8, (2,), np.float32),
        observation_space_mapping=lambda cell: [
            cell.state,
            sum(other.is_alive for other in cell.neighbors),
        ],
        action_space=Discrete(2),
        apply=lambda action, cell: setattr(cell, "_next_state", int(action)),
        reward_mapping=lambda cell: cell.state,
        agent=lambda cell: f"cell_{cell.unique_id}",
        question="Does the cell live in the next step?",
        display_mapping=lambda cell: {
            "it lives now": "yes" if cell.is_alive else "no",
            "living neighbours": sum(other.is_alive for other in cell.neighbors),
        },
        action_labels=["no", "yes"],
        observation_labels=["it lives", "living neighbours"],
    )
    return (
        ConwaysGameOfLife,
        {"mesa.examples.basic.conways_game_of_life.agents.Cell.determine_state": state},
        {},
    )


def virus_on_network() -> Example:
    """A computer decides on its treatment.

    The network uses Python's global generator, hence ``global_rng``.
    """
    check = make_step(
        observation_space=Discrete(3),
        observation_space_mapping=lambda node: node.state.value,
        action_space=Discrete(2),
        apply=lambda action, node: (
            node.try_remove_infection() if action and node.state.value == 1 else None
        ),
        reward_mapping=lambda node: -float(node.state.value == 1),
        agent=lambda node: f"node_{node.unique_id}",
        question="Is the computer treated?",
        display_mapping=lambda node: {"state": node.state.name.lower()},
        action_labels=["no", "yes"],
        observation_labels={0: "susceptible", 1: "infected", 2: "resistant"},
    )
    points = {"mesa.examples.basic.virus_on_network.agents.VirusAgent.check_situation": check}
    return VirusOnNetwork, points, {"global_rng": True}


def epstein_civil_violence() -> Example:
    """A cop decides where to go.

    The inherited ``Cop.move``, named like this, leaves the citizens' move unchanged.
    """
    patrol = make_step(
        observation_space=Box(0, np.inf, (2,), np.float32),
        observation_space_mapping=lambda cop: [
            sum(1 for _ in cop.neighbors),
            len(cop.empty_neighbors),
        ],
        action_space=Discrete(250),
        choices=lambda cop: [cop.cell, *cop.empty_neighbors],
        apply=lambda cell, cop: None if cell is cop.cell else cop.move_to(cell),
        reward_mapping=lambda cop: -float(cop.model.ACTIVE),
        agent=lambda cop: f"cop_{cop.unique_id}",
        question="Where does the cop go?",
        display_mapping=lambda cop: {
            "persons in sight": sum(1 for _ in cop.neighbors),
            "active citizens": cop.model.ACTIVE,
        },
        action_labels=lambda cop: places([cop.cell, *cop.empty_neighbors]),
        observation_labels=["persons in sight", "free places in sight"],
    )
    return (
        EpsteinCivilViolence,
        {"mesa.examples.advanced.epstein_civil_violence.agents.Cop.move": patrol},
        {},
    )


def pd_grid() -> Example:
    """A prisoner decides whether to cooperate."""
    cooperate = make_step(
        observation_space=Box(0, np.inf, (3,), np.float32),
        observation_space_mapping=lambda prisoner: [
            prisoner.score,
            prisoner.is_cooroperating,
            sum(other.is_cooroperating for other in prisoner.cell.neighborhood.agents),
        ],
        action_space=Discrete(2),
        apply=lambda action, prisoner: setattr(prisoner, "next_move", "CD"[action]),
        reward_mapping=difference(lambda prisoner: prisoner.score),
        agent=lambda prisoner: f"prisoner_{prisoner.unique_id}",
        question="Does the prisoner cooperate?",
        display_mapping=lambda prisoner: {
            "score": prisoner.score,
            "cooperates now": "yes" if prisoner.is_cooroperating else "no",
        },
        action_labels=["cooperate", "defect"],
        observation_labels=["score", "cooperates", "neighbours who cooperate"],
    )
    return PdGrid, {"mesa.examples.advanced.pd_grid.agents.PDAgent.step": cooperate}, {}


def sugarscape() -> Example:
    """A trader decides where to go, until it starves."""

    def reach(trader: Any) -> list[Any]:
        around = trader.cell.get_neighborhood(trader.vision)
        return [trader.cell, *(cell for cell in around if cell.is_empty)]

    move = make_step(
        observation_space=Box(-np.inf, np.inf, (4,), np.float32),
        observation_space_mapping=lambda trader: [
            trader.sugar,
            trader.spice,
            trader.cell.sugar,
            trader.cell.spice,
        ],
        action_space=Discrete(62),
        choices=reach,
        action_labels=lambda trader: places(reach(trader)),
        apply=lambda cell, trader: setattr(trader, "cell", cell),
        reward_mapping=lambda trader: 1.0,
        agent=lambda trader: f"trader_{trader.unique_id}",
        question="Where does the trader go?",
        display_mapping=lambda trader: {
            "sugar": trader.sugar,
            "spice": trader.spice,
            "sugar here": trader.cell.sugar,
            "spice here": trader.cell.spice,
        },
        observation_labels=["sugar", "spice", "sugar here", "spice here"],
        removed_by="mesa.agent.Agent.remove",
    )
    return SugarscapeG1mt, {"mesa.examples.advanced.sugarscape_g1mt.agents.Trader.move": move}, {}


def wolf_sheep() -> Example:
    """Wolves and sheep decide where to go, from birth to death."""

    def moves(kind: str) -> Definition:
        return make_step(
            observation_space=Box(-1, np.inf, (2,), np.float32),
            observation_space_mapping=lambda animal: [animal.energy, len(animal.cell.agents)],
            action_space=Discrete(4),
            apply=lambda action, animal: setattr(
                animal, "cell", list(animal.cell.neighborhood)[action]
            ),
            reward_mapping=lambda animal: 1.0,
            agent=lambda animal: f"{kind}_{animal.unique_id}",
            question=f"Where does the {kind.lower()} go?",
            display_mapping=lambda animal: {
                "energy": animal.energy,
                "animals and grass here": len(animal.cell.agents),
            },
            action_labels=lambda animal: places(animal.cell.neighborhood),
            observation_labels=["energy", "animals and grass here"],
            removed_by="mesa.agent.Agent.remove",
        )

    points = {
        f"mesa.examples.advanced.wolf_sheep.agents.{kind}.move": moves(kind)
        for kind in ("Wolf", "Sheep")
    }
    return WolfSheep, points, {}


def alliance_formation() -> Example:
    """One agent decides for each pair whether it joins: the model's agents have no behaviour."""
    worth = MultiLevelAllianceModel.calculate_shapley_value  # the rule
    join = make_step(
        observation_space=Box(0, np.inf, (4,), np.float32),
        observation_space_mapping=lambda model, pair: [
            number for one in pair for number in (one.power, one.position)
        ],
        action_space=Discrete(2),
        apply=lambda action, model, pair: worth(model, pair) if action else None,
        reward_mapping=difference(lambda model, pair: max(agent.power for agent in model.agents)),
        agent="matchmaker_0",
        question="Do these two join?",
        display_mapping=lambda model, pair: {
            f"{name} of the {place}": f"{getattr(one, name):.3f}"
            for place, one in zip(("first", "second"), pair, strict=True)
            for name in ("power", "position")
        },
        action_labels=["no", "yes"],
        observation_labels=["power 1", "position 1", "power 2", "position 2"],
    )
    name = (
        "mesa.examples.advanced.alliance_formation.model."
        "MultiLevelAllianceModel.calculate_shapley_value"
    )
    return MultiLevelAllianceModel, {name: join}, {}


NEEDS_SIMULATOR: Final = "simulator" in inspect.signature(WolfSheep).parameters
"""Whether a simulator runs ``WolfSheep``, as before Mesa 3.5.

Then only ``examples.wolf_sheep`` runs it.
"""

EXAMPLES: Final = (
    boltzmann_wealth, schelling, boid_flockers, conways_game_of_life, virus_on_network,
    epstein_civil_violence, pd_grid, sugarscape, wolf_sheep, alliance_formation,
)  # fmt: skip


# -- running the models ---------------------------------------------------------------------------


def stepped(model: Callable[..., Any], steps: int = STEPS) -> SteppedSimulation:
    """Make a simulation of one of these models, which takes a seed, or a scenario with the seed."""
    known = vars(sys.modules[model.__module__])
    scenario = next(
        (known[name] for name in known if name.endswith("Scenario") and name != "Scenario"), None
    )
    if scenario is None:
        return SteppedSimulation(model, steps)
    return SteppedSimulation(lambda seed: model(scenario=scenario(rng=seed)), steps)


def fingerprint(simulation: SteppedSimulation) -> str:
    """Write the state of a model as text: agents, landscape, generators, collected data."""
    model = simulation.model
    agents = [
        (
            type(agent).__name__,
            {name: plain(value) for name, value in vars(agent).items()},
            positions(agent),
        )
        for agent in model.agents
    ]
    layers = getattr(getattr(model, "grid", None), "_mesa_property_layers", {})
    landscape = {name: plain(layer.data) for name, layer in layers.items()}
    # A model of Mesa 4.0.0a0 has a seed in place of this generator.
    generator = getattr(model.rng, "bit_generator", None)
    state = None if generator is None else generator.state
    collected = (
        plain(list(model.datacollector.model_vars.values()))
        if hasattr(model, "datacollector")
        else None
    )
    return repr([agents, landscape, model.random.getstate(), state, collected])


def positions(agent: Any) -> Any:
    """Return the position of an agent in a continuous space, which its ``vars`` lack."""
    return plain(agent.position) if hasattr(agent, "space") else None


def plain(value: Any) -> Any:
    """Make a value comparable: numbers and names stay, objects become coordinates or types."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if value is None or isinstance(value, bool | int | float | str | Enum):
        return value
    return value.coordinate if hasattr(value, "coordinate") else type(value).__name__


def run_plainly(example: Example, seed: int) -> str:
    """Run a model without an environment, after seeding the global generators.

    It returns the final state.
    """
    simulation = stepped(example[0])
    random.seed(seed)
    np.random.seed(seed)
    simulation.reset(seed)
    simulation.run()
    return fingerprint(simulation)


def play(example: Example, seed: int, answer: Callable[[Any, str], Any]) -> tuple[int, int, str]:
    """Play an episode of a model's AEC environment.

    Returns:
        The number of agents, the number of decisions, and the final state of the model.
    """
    model, points, options = example
    env = aec_env(stepped(model), points, **options)
    env.reset(seed=seed)
    decisions: Counter[str] = Counter()
    for agent in env.agent_iter():
        over = env.terminations[agent] or env.truncations[agent]
        decisions[agent] += not over
        env.step(None if over else answer(env, agent))
    held = fingerprint(env.simulation)
    env.close()
    return len(decisions), decisions.total(), held


def by_rule(env: Any, agent: str) -> Any:
    """Follow the model's rule."""
    return RULE


def at_random(env: Any, agent: str) -> Any:
    """Draw a legal action."""
    return env.action_space(agent).sample(env.infos[agent].get("action_mask"))


@dataclass(frozen=True)
class Outcome:
    """The results of an example.

    Attributes:
        model: Its name.
        decisions: The names of its decision points.
        lines: The number of lines of code of its definition, without docstring and empty lines.
        agents: The number of agents that decided in an episode.
        asked: The number of decisions in an episode.
        same: Whether the run with ``RULE`` gives the same state as the run without an environment.
        moved: Whether random actions give another state.
    """

    model: str
    decisions: str
    lines: int
    agents: int
    asked: int
    same: bool
    moved: bool


def outcome(function: Callable[[], Example], seed: int = 5) -> Outcome:
    """Run an example without an environment, by its rule, and with random actions."""
    model, points, _ = function()
    agents, asked, by_rules = play(function(), seed, by_rule)
    return Outcome(
        model=model.__name__,
        decisions=", ".join(
            ".".join(name.split(".")[-2:]).removeprefix(f"{model.__name__}.") for name in points
        ),
        # its docstring
        lines=sum(bool(line.strip()) for line in inspect.getsource(function).splitlines()) - 1,
        agents=agents,
        asked=asked,
        same=by_rules == run_plainly(function(), seed),
        moved=by_rules != play(function(), seed, at_random)[2],
    )


def table(outcomes: Iterable[Outcome]) -> str:
    """Make the table, in Markdown."""
    lines = [
        "| model | decision | lines | agents | decisions | same |",
        "| --- | --- | ---: | ---: | ---: | --- |",
    ]
    lines += [
        f"| `{one.model}` | `{one.decisions}` | {one.lines} | {one.agents} | {one.asked} |"
        f" {'yes' if one.same else 'NO'} |"
        for one in outcomes
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the examples, and print the table."""
    parser = argparse.ArgumentParser(
        description="Run Mesa's example models as environments, and by themselves."
    )
    names = [
        function.__name__
        for function in EXAMPLES
        if function is not wolf_sheep or not NEEDS_SIMULATOR
    ]
    parser.add_argument(
        "names", nargs="*", default=names, help="which examples to run (default: all)"
    )
    outcomes = [outcome(globals()[name]) for name in parser.parse_args(arguments).names]
    print(f"Mesa {mesa.__version__}, Python {platform.python_version()}, {STEPS} steps")
    print(table(outcomes))
    if not all(one.same and one.moved for one in outcomes):
        raise SystemExit("some models differ under RULE, or do not react to random actions")


if __name__ == "__main__":
    main()
