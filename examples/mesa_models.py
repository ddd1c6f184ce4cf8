"""Mesa's own example models as environments: not a line of them is changed, and each function is all that one needs.

``python -m examples.mesa_models`` runs each of them plainly and as an AEC environment with ``RULE`` throughout,
compares all that the two models hold afterwards, plays random actions, and prints a table in Markdown. It needs Mesa
3.3 or newer, with its extra ``network``.

From Mesa 3.5 on, some of these models take a scenario. ``stepped`` makes them in either way; a model of your own needs
``SteppedSimulation`` alone.
"""

from __future__ import annotations

import inspect
import math
import platform
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterable
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
"""How many steps of a model are run."""

Example = tuple[Callable[..., Any], dict[str, Definition], dict[str, Any]]
"""A model, its decision points and the options of its environments."""


def boltzmann_wealth() -> Example:
    """Where a person goes, who gives money away there."""
    move = make_step(
        observation_space=Box(0, np.inf, (2,), np.float32),
        observation_space_mapping=lambda person: [person.wealth, len(person.cell.agents) - 1],
        action_space=Discrete(8),
        choices=lambda person: list(person.cell.neighborhood),
        apply=lambda cell, person: setattr(person, "cell", cell),
        reward_mapping=difference(lambda person: person.wealth),
        agent=lambda person: f"person_{person.unique_id}",
    )
    return BoltzmannWealth, {"mesa.examples.basic.boltzmann_wealth_model.agents.MoneyAgent.move": move}, {}


def schelling() -> Example:
    """Whether a household moves to another place."""

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
    )
    return Schelling, {"mesa.examples.basic.schelling.agents.SchellingAgent.step": step}, {}


def boid_flockers() -> Example:
    """By how much a bird turns."""

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
    )
    return BoidFlockers, {"mesa.examples.basic.boid_flockers.agents.Boid.step": step}, {}


def conways_game_of_life() -> Example:
    """Whether a cell lives on."""
    state = make_step(
        observation_space=Box(0, 8, (2,), np.float32),
        observation_space_mapping=lambda cell: [cell.state, sum(other.is_alive for other in cell.neighbors)],
        action_space=Discrete(2),
        apply=lambda action, cell: setattr(cell, "_next_state", int(action)),
        reward_mapping=lambda cell: cell.state,
        agent=lambda cell: f"cell_{cell.unique_id}",
    )
    return ConwaysGameOfLife, {"mesa.examples.basic.conways_game_of_life.agents.Cell.determine_state": state}, {}


def virus_on_network() -> Example:
    """Whether a computer is treated. The network is drawn from Python's global generator: hence ``global_rng``."""
    check = make_step(
        observation_space=Discrete(3),
        observation_space_mapping=lambda node: node.state.value,
        action_space=Discrete(2),
        apply=lambda action, node: node.try_remove_infection() if action and node.state.value == 1 else None,
        reward_mapping=lambda node: -float(node.state.value == 1),
        agent=lambda node: f"node_{node.unique_id}",
    )
    points = {"mesa.examples.basic.virus_on_network.agents.VirusAgent.check_situation": check}
    return VirusOnNetwork, points, {"global_rng": True}


def epstein_civil_violence() -> Example:
    """Where a cop goes. ``Cop.move`` is inherited; named so, it is the cops' alone, and citizens keep theirs."""
    patrol = make_step(
        observation_space=Box(0, np.inf, (2,), np.float32),
        observation_space_mapping=lambda cop: [sum(1 for _ in cop.neighbors), len(cop.empty_neighbors)],
        action_space=Discrete(250),
        choices=lambda cop: [cop.cell, *cop.empty_neighbors],
        apply=lambda cell, cop: None if cell is cop.cell else cop.move_to(cell),
        reward_mapping=lambda cop: -float(cop.model.ACTIVE),
        agent=lambda cop: f"cop_{cop.unique_id}",
    )
    return EpsteinCivilViolence, {"mesa.examples.advanced.epstein_civil_violence.agents.Cop.move": patrol}, {}


def pd_grid() -> Example:
    """Whether a prisoner cooperates."""
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
    )
    return PdGrid, {"mesa.examples.advanced.pd_grid.agents.PDAgent.step": cooperate}, {}


def sugarscape() -> Example:
    """Where a trader goes, until it starves."""
    move = make_step(
        observation_space=Box(-np.inf, np.inf, (4,), np.float32),
        observation_space_mapping=lambda trader: [trader.sugar, trader.spice, trader.cell.sugar, trader.cell.spice],
        action_space=Discrete(62),
        choices=lambda trader: [
            trader.cell,
            *(cell for cell in trader.cell.get_neighborhood(trader.vision) if cell.is_empty),
        ],
        apply=lambda cell, trader: setattr(trader, "cell", cell),
        reward_mapping=lambda trader: 1.0,
        agent=lambda trader: f"trader_{trader.unique_id}",
        removed_by="mesa.agent.Agent.remove",
    )
    return SugarscapeG1mt, {"mesa.examples.advanced.sugarscape_g1mt.agents.Trader.move": move}, {}


def wolf_sheep() -> Example:
    """Where wolves and sheep go, from their birth to their death."""

    def moves(kind: str) -> Definition:
        return make_step(
            observation_space=Box(-1, np.inf, (2,), np.float32),
            observation_space_mapping=lambda animal: [animal.energy, len(animal.cell.agents)],
            action_space=Discrete(4),
            apply=lambda action, animal: setattr(animal, "cell", list(animal.cell.neighborhood)[action]),
            reward_mapping=lambda animal: 1.0,
            agent=lambda animal: f"{kind}_{animal.unique_id}",
            removed_by="mesa.agent.Agent.remove",
        )

    points = {f"mesa.examples.advanced.wolf_sheep.agents.{kind}.move": moves(kind) for kind in ("Wolf", "Sheep")}
    return WolfSheep, points, {}


def alliance_formation() -> Example:
    """Whether two join: agents have no behaviour of their own in this model, so one agent decides for all pairs."""
    worth = MultiLevelAllianceModel.calculate_shapley_value  # the rule
    join = make_step(
        observation_space=Box(0, np.inf, (4,), np.float32),
        observation_space_mapping=lambda model, pair: [number for one in pair for number in (one.power, one.position)],
        action_space=Discrete(2),
        apply=lambda action, model, pair: worth(model, pair) if action else None,
        reward_mapping=difference(lambda model, pair: max(agent.power for agent in model.agents)),
        agent="matchmaker_0",
    )
    name = "mesa.examples.advanced.alliance_formation.model.MultiLevelAllianceModel.calculate_shapley_value"
    return MultiLevelAllianceModel, {name: join}, {}


EXAMPLES: Final = (
    boltzmann_wealth, schelling, boid_flockers, conways_game_of_life, virus_on_network, epstein_civil_violence, pd_grid,
    sugarscape, wolf_sheep, alliance_formation,
)  # fmt: skip


# -- how they are run -----------------------------------------------------------------------------


def stepped(model: Callable[..., Any], steps: int = STEPS) -> SteppedSimulation:
    """Make a simulation of one of these models: with its seed, or with a scenario that holds the seed."""
    known = vars(sys.modules[model.__module__])
    scenario = next((known[name] for name in known if name.endswith("Scenario") and name != "Scenario"), None)
    if scenario is None:
        return SteppedSimulation(model, steps)
    return SteppedSimulation(lambda seed: model(scenario=scenario(rng=seed)), steps)


def fingerprint(simulation: SteppedSimulation) -> str:
    """Take down all that a model holds that is a number or a name: agents, landscape, generators, collected data."""
    model = simulation.model
    agents = [
        (type(agent).__name__, {name: plain(value) for name, value in vars(agent).items()}, positions(agent))
        for agent in model.agents
    ]
    layers = getattr(getattr(model, "grid", None), "_mesa_property_layers", {})
    landscape = {name: plain(layer.data) for name, layer in layers.items()}
    collected = plain(list(model.datacollector.model_vars.values())) if hasattr(model, "datacollector") else None
    return repr([agents, landscape, model.random.getstate(), model.rng.bit_generator.state, collected])


def positions(agent: Any) -> Any:
    """Where an agent of a continuous space is; it is not held by the agent itself."""
    return plain(agent.position) if hasattr(agent, "space") else None


def plain(value: Any) -> Any:
    """Make a value one that can be compared: what is no number and no name counts by its place or its type."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if value is None or isinstance(value, bool | int | float | str | Enum):
        return value
    return value.coordinate if hasattr(value, "coordinate") else type(value).__name__


def run_plainly(example: Example, seed: int) -> str:
    """Run a model as it is, after seeding the global generators, and take down what it then holds."""
    simulation = stepped(example[0])
    random.seed(seed)
    np.random.seed(seed)
    simulation.reset(seed)
    simulation.run()
    return fingerprint(simulation)


def play(example: Example, seed: int, answer: Callable[[Any, str], Any]) -> tuple[int, int, str]:
    """Play an episode of the AEC environment of a model.

    Returns:
        How many agents and how many decisions there were, and what the model then holds.
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
    """Leave it to the model."""
    return RULE


def at_random(env: Any, agent: str) -> Any:
    """Take any legal action."""
    return env.action_space(agent).sample(env.infos[agent].get("action_mask"))


@dataclass(frozen=True)
class Outcome:
    """What has become of an example.

    Attributes:
        model: Its name.
        decisions: The names of its decision points.
        lines: How many lines of code its definition has, without comments and empty lines.
        agents: How many agents have decided in an episode.
        asked: How many decisions there were in it.
        same: Whether the run with ``RULE`` throughout is the plain run.
        moved: Whether random actions make it another.
    """

    model: str
    decisions: str
    lines: int
    agents: int
    asked: int
    same: bool
    moved: bool


def outcome(function: Callable[[], Example], seed: int = 5) -> Outcome:
    """Run an example plainly, by rule, and with random actions."""
    model, points, _ = function()
    agents, asked, by_rules = play(function(), seed, by_rule)
    return Outcome(
        model=model.__name__,
        decisions=", ".join(".".join(name.split(".")[-2:]).removeprefix(f"{model.__name__}.") for name in points),
        lines=sum(bool(line.strip()) for line in inspect.getsource(function).splitlines()) - 1,  # its docstring
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


def main() -> None:
    """Run all examples, and print the table."""
    outcomes = [outcome(function) for function in EXAMPLES]
    print(f"Mesa {mesa.__version__}, Python {platform.python_version()}, {STEPS} steps")
    print(table(outcomes))
    if not all(one.same and one.moved for one in outcomes):
        raise SystemExit("some are not what they should be")


if __name__ == "__main__":
    main()
