"""Draw the pictures of the gallery of the front page that no study draws.

Run ``OMP_NUM_THREADS=1 python -m docs.figures.gallery`` from the root of the repository, after
``pip install ".[clients,fmi]"``. Names of pictures as arguments restrict it to these. The town
needs a JDK, the robots need Enki, and the follower needs ROS 1.
"""

import sys
from pathlib import Path
from runpy import run_module
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from simenv_marl import RULE, evaluate, single_env
from simenv_marl.experiments import Evaluation

HERE = Path(__file__).parent


def of_template(kind: str) -> Evaluation:
    """Run a template, which trains its policy, and compare the policy with the rule."""
    names = run_module(f"simenv_marl.testing.templates.{kind}", run_name="__main__")
    return evaluate(names["MySimulation"], names["policies"], seeds=names["seeds"], baseline="rule")


def town() -> Any:
    """Compare policies for the farms of the town in Java."""
    from examples.jvm_market.compare import compare

    return compare(seeds=range(20), weeks=52).plot()


def observed(env: Any, policy: Any, seed: int) -> np.ndarray:
    """Play an episode of a single view; return its observations, one row each."""
    observation, _ = env.reset(seed=seed)
    rows, over = [observation], False
    while not over:
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        rows.append(observation)
        over = terminated or truncated
    env.close()
    flat = [np.concatenate(list(row.values())) if isinstance(row, dict) else row for row in rows]
    return np.array(flat)


def over_time(
    curves: dict[str, np.ndarray], step: float, xlabel: str, ylabel: str, target: float
) -> Any:
    """Draw curves over time, and the value that is best."""
    figure, axes = plt.subplots(figsize=(6.4, 4.8))
    for label, values in curves.items():
        axes.plot(step * np.arange(len(values)), values, label=label)
    axes.axhline(target, color="grey", linestyle=":")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.legend()
    return figure


def room() -> Any:
    """Draw the temperature of the room by its thermostat, and by the trained heater."""
    from examples.heated_room.env import COMFORT, RoomSim
    from examples.heated_room.train import HELD_OUT, learn

    env = single_env(RoomSim)
    column = list(env.observation_space).index("temperature")
    policies = {"thermostat": lambda _: RULE, "trained": learn(25)}
    temperatures = {
        label: observed(env, policy, HELD_OUT)[:, column] for label, policy in policies.items()
    }
    return over_time(temperatures, 1 / 4, "hours", "temperature of the room, °C", COMFORT)


def follower() -> Any:
    """Draw the follower's distance to its leader: by its rule, and at half the speed."""
    from examples.ros_follower import env as ros

    def slower(observation: np.ndarray) -> list[float]:
        return [min(1.0, max(0.0, 0.5 * observation[0])), float(np.clip(observation[1], -1, 1))]

    policies = {"rule": lambda _: RULE, "another policy": slower}
    distances = {
        label: np.hypot(*observed(ros.env(), policy, 7).T) for label, policy in policies.items()
    }
    return over_time(distances, 1 / 10, "seconds", "distance to the leader, m", 1.0)


def robots() -> Any:
    """Compare the rule of the robots with going straight on."""
    from examples.enki_robots.env import robots

    straight = {f"robot_{number}": lambda observation: [0.0] for number in range(6)}
    return evaluate(
        robots, {"rule": {}, "straight on": straight}, seeds=range(10), baseline="rule"
    ).plot()


def market() -> Any:
    """Draw the profits of the traders in both conditions, by the rule and with five crates each."""
    from examples.market_seats.env import AGENTS, Free, Levied

    contenders = {
        "each for itself (rule)": {},
        "five crates each": dict.fromkeys(AGENTS, lambda observation: 5),
    }
    figure, axes = plt.subplots(figsize=(6.4, 4.8))
    for shift, condition in zip((-0.2, 0.2), (Free, Levied), strict=True):
        means = evaluate(condition, contenders, seeds=range(50)).summary()["mean"] / len(AGENTS)
        axes.bar(np.arange(len(means)) + shift, means, 0.4, label=condition.__name__)
    axes.set_xticks(range(len(contenders)), contenders)
    axes.set_ylabel("profit of a trader")
    axes.legend(loc="lower right")
    return figure


def mesa() -> Any:
    """Draw three of Mesa's models at the end of an episode."""
    from examples import mesa_models

    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.6))
    for axes, example in zip(panels, ("schelling", "boid_flockers", "sugarscape"), strict=True):
        model = mesa_models.stepped(getattr(mesa_models, example)()[0], 30)
        model.reset(5)
        model.run()
        agents = list(model.model.agents)
        places = np.array(
            [
                agent.position if hasattr(agent, "position") else agent.cell.coordinate
                for agent in agents
            ]
        )
        colours = [getattr(agent, "type", 0) if example == "schelling" else 0 for agent in agents]
        axes.scatter(*places.T, c=colours, s=6, cmap="coolwarm")
        axes.set(title=type(model.model).__name__, xticks=[], yticks=[], aspect="equal")
    return figure


PICTURES = {
    **{
        f"template-{kind}": lambda kind=kind: of_template(kind).plot()
        for kind in ("plain", "simpy", "mesa")
    },
    "jvm-market": town,
    "heated-room": room,
    "ros-follower": follower,
    "enki-robots": robots,
    "market-seats": market,
    "mesa-models": mesa,
}


def main() -> None:
    """Save the pictures."""
    for name in sys.argv[1:] or PICTURES:
        PICTURES[name]().savefig(HERE / f"{name}.png", dpi=100, bbox_inches="tight")


if __name__ == "__main__":
    main()
