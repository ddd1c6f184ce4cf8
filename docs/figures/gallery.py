"""Draw the pictures of the front page: its result, and those of its gallery.

Each is drawn for the size at which the page shows it.

Run ``python -m docs.figures.gallery`` from the root of the repository, after
``pip install ".[clients]"`` and ``make demo``. Names of pictures as arguments restrict it to these.
Models of the repository are run for their pictures. The others are drawings.
"""

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle
from studies.report import new_figure

from simenv_marl import simulate

HERE = Path(__file__).parent
DEMO = HERE.parents[1] / "examples/greenhouse_coop/out/greenhouse.json"

GREY, ORANGE, BLUE = "#8c8c8c", "#d1812c", "#2f7fb5"
GREEN, RED, INK = "#1b6f5f", "#b5443a", "#333333"
PALE, SILVER, SAND = "#e8ecef", "#c5ccd1", "#f3d9bd"
BOLD: dict[str, Any] = {"weight": "bold", "fontsize": 24}
MIDDLE: dict[str, Any] = {"weight": "bold", "ha": "center", "va": "center"}


# -- curves and maps of runs ----------------------------------------------------------------------


def battery(axes: Axes) -> None:
    """Draw the charge of the home battery over three days, and the price of a kWh behind it."""
    from simenv_marl.testing.templates.plain import MyModel

    model, charges, prices = MyModel(1), [], []
    for _ in range(72):
        prices.append(MyModel.prices[model.hour % 24])
        model.end_hour()
        charges.append(model.charge)
    hours = range(72)
    dear = [SAND if price > 0.4 else PALE for price in prices]
    axes.bar(hours, np.array(prices) / 0.45 * 10, 1, color=dear)
    axes.plot(hours, charges, color=GREEN, linewidth=6)
    axes.text(2, 9.7, "charge", color=GREEN, **BOLD)
    axes.text(41, 11, "price", color=ORANGE, **BOLD)
    axes.set(xlim=(-0.5, 71.5), ylim=(0, 12.5))


def paint_shop(axes: Axes) -> None:
    """Draw which jobs wait in the paint shop, and for how long, until each is painted."""
    from simenv_marl.testing.templates import simpy

    class Shop(simpy.MyModel):
        def choose_job(self) -> Any:
            job = super().choose_job()
            rows.append((job, self.clock.now))
            return job

    rows: list[Any] = []
    Shop(3).clock.run(240)
    for row, (job, start) in enumerate(rows[2:11]):
        colour = RED if start + job.minutes > job.due else BLUE
        axes.broken_barh([(start, job.minutes)], (-row, 0.75), color=colour)
        axes.plot([max(0, job.due - 120), start], [0.375 - row] * 2, color=SILVER, linewidth=5)
    axes.set(ylim=(-8.6, 1.2), xlim=(rows[2][1] - 25, rows[10][1] + 25))


def rabbits(axes: Axes) -> None:
    """Draw the rabbits on their meadow."""
    from simenv_marl.testing.templates.mesa import MySimulation

    model = simulate(MySimulation(), seed=4).model
    axes.imshow(model.grass, cmap="Greens", vmin=-0.3, vmax=1.6, extent=(-0.5, 11.5, 11.5, -0.5))
    rows, columns = positions(list(model.agents))
    axes.scatter(columns, rows, s=330, color="white", edgecolors=INK, linewidths=3)
    axes.set(ylim=(8.5, 2.5), aspect="equal")


def greenhouse(axes: Axes) -> None:
    """Draw the living plants of the demo, by the rule and by its trained agents."""
    for title, place in (("both trained", (34, 135)), ("rule", (14, 40))):
        label, colour = TEAMS[title]
        axes.plot(np.mean(of_demo("alive")[title], axis=0), color=colour, linewidth=7)
        axes.text(*place, label, color=colour, fontsize=26, weight="bold")
    axes.axhline(0, color=INK, linewidth=2)
    axes.set(ylim=(-12, 225), xlim=(-2, 100))


def futures(axes: Axes) -> None:
    """Draw futures of a greenhouse after three amounts of water: plants that will be alive."""
    from examples.greenhouse_coop.model import Greenhouse

    for litres, colour in ((30, BLUE), (75, GREEN), (200, RED)):
        for seed in range(12):
            house, alive = Greenhouse(3), []
            house.choose_water_amount = lambda: 70  # type: ignore[method-assign]
            for day in range(30):
                if day == 12:
                    house.random.seed(seed)
                    house.choose_water_amount = partial(int, litres)  # type: ignore[method-assign]
                house.update_day()
                alive.append(np.mean([plant.health for plant in house.pots]))
            axes.plot(range(12, 30), alive[12:], color=colour, linewidth=2.5, alpha=0.6)
    axes.plot(range(13), alive[:13], color=INK, linewidth=7)
    axes.plot(12, alive[12], "o", color=INK, markersize=20)
    axes.margins(0.05, 0.1)


def matrix(axes: Axes) -> None:
    """Draw the days that the plants live by their rule, in greenhouses of 27 kinds."""
    from studies.greenhouse_matrix.matrix import FACTORS
    from studies.greenhouse_matrix.variants import greenhouse as kind

    days = [
        [
            simulate(kind(plants, climate, exchange), seed=1).greenhouse.day
            for plants in FACTORS["plants"]
            for exchange in FACTORS["exchange"]
        ]
        for climate in FACTORS["climate"]
    ]
    axes.pcolormesh(np.log(np.array(days)), cmap="YlGn", edgecolors="white", linewidth=5)


def mesa(axes: Axes) -> None:
    """Draw three of Mesa's models at the end of an episode."""
    from examples import mesa_models

    for shift, example in enumerate(("schelling", "boid_flockers", "sugarscape")):
        model = mesa_models.stepped(getattr(mesa_models, example)()[0], 30)
        model.reset(5)
        model.run()
        agents = list(model.model.agents)
        places = np.array(
            [
                agent.position if hasattr(agent, "position") else agent.cell.coordinate
                for agent in agents
            ],
            float,
        )
        places = (places - places.min(0)) / np.ptp(places, 0) * (1, 1.45)
        colours = [(BLUE, RED)[getattr(agent, "type", 0) if not shift else 0] for agent in agents]
        colours = colours if not shift else (GREEN, ORANGE)[shift - 1]
        axes.scatter(1.12 * shift + places[:, 0], places[:, 1], c=colours, s=40, linewidths=0)
    axes.set(aspect="equal")


def positions(agents: list[Any]) -> Any:
    """Return the columns of the agents' cells, and their rows."""
    return np.array([agent.cell.coordinate for agent in agents]).T


def meadow(axes: Axes) -> None:
    """Draw sheep and wolves on the meadow of Mesa's model."""
    from examples.wolf_sheep.env import Meadow
    from mesa.examples.advanced.wolf_sheep.agents import Sheep, Wolf

    model = simulate(Meadow(2), seed=2, points={}).model
    grass = [agent for agent in model.agents if getattr(agent, "fully_grown", False)]
    animals = {kind: list(model.agents_by_type[kind]) for kind in (Sheep, Wolf)}
    axes.scatter(*positions(grass), color="#d4e8d0", s=470, marker="s", linewidths=0)
    axes.scatter(*positions(animals[Sheep]), color="white", s=230, edgecolors=INK, linewidths=3)
    axes.scatter(*positions(animals[Wolf]), color=INK, s=260)
    axes.set(xlim=(-0.5, 19.5), ylim=(4.5, 14.5), aspect="equal")


# -- drawings -------------------------------------------------------------------------------------


def canvas(axes: Axes) -> None:
    """Make the axes a drawing board, two units wide and one high."""
    axes.set(xlim=(0, 2), ylim=(0, 1), aspect="equal")


def box(axes: Axes, x: float, y: float, width: float, height: float, colour: str) -> None:
    """Draw a box with round corners."""
    axes.add_patch(
        FancyBboxPatch(
            (x, y), width, height, boxstyle="round,pad=0,rounding_size=0.05", fc=colour, ec="none"
        )
    )


def disc(axes: Axes, x: float, y: float, radius: float, colour: str) -> None:
    """Draw a disc."""
    axes.add_patch(Circle((x, y), radius, color=colour, linewidth=0))


def arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str = INK
) -> None:
    """Draw an arrow."""
    axes.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": "-|>", "lw": 5, "color": colour, "mutation_scale": 32},
    )


def page_of_play(axes: Axes) -> None:
    """Draw the page of play: a question, a slider, a button, and three futures."""
    canvas(axes)
    axes.text(0.06, 0.82, "How much water?", fontsize=27, weight="bold", color=INK)
    axes.plot([0.08, 1.2], [0.67, 0.67], color=SILVER, linewidth=9, solid_capstyle="round")
    axes.plot([0.08, 0.4], [0.67, 0.67], color=BLUE, linewidth=9, solid_capstyle="round")
    disc(axes, 0.42, 0.67, 0.06, BLUE)
    box(axes, 1.34, 0.56, 0.6, 0.22, BLUE)
    axes.text(1.64, 0.665, "Decide", fontsize=24, color="white", **MIDDLE)
    days = np.linspace(0, 1, 20)
    for number, (bend, colour) in enumerate(((0.9, GREEN), (0.5, GREY), (0.1, RED))):
        left = 0.06 + 0.645 * number
        box(axes, left, 0.05, 0.59, 0.4, PALE)
        axes.plot(
            left + 0.06 + 0.47 * days, 0.1 + 0.27 * days**0.6 * bend, color=colour, linewidth=7
        )


def traders(axes: Axes) -> None:
    """Draw four people around a market, and one good that they trade."""
    canvas(axes)
    box(axes, 0.74, 0.33, 0.52, 0.34, SAND)
    axes.text(1, 0.49, "market", color=INK, fontsize=24, **MIDDLE)
    for x, y, colour in (
        (0.25, 0.66, BLUE),
        (0.25, 0.14, GREEN),
        (1.75, 0.66, ORANGE),
        (1.75, 0.14, RED),
    ):
        disc(axes, x, y + 0.16, 0.085, colour)
        box(axes, x - 0.14, y - 0.1, 0.28, 0.16, colour)
        end = 0.7 if x < 1 else 1.3
        arrow(
            axes,
            (x + (0.18 if x < 1 else -0.18), y + 0.03),
            (end, 0.56 if y > 0.4 else 0.42),
            colour,
        )


def queue(axes: Axes) -> None:
    """Draw a queue in front of a server, and a job that is turned away."""
    canvas(axes)
    for number in range(4):
        disc(axes, 0.62 + 0.23 * number, 0.4, 0.095, BLUE)
    box(axes, 1.5, 0.2, 0.42, 0.4, GREEN)
    disc(axes, 1.71, 0.4, 0.095, "white")
    disc(axes, 0.12, 0.4, 0.095, ORANGE)
    arrow(axes, (0.24, 0.4), (0.5, 0.4))
    arrow(axes, (0.2, 0.48), (0.42, 0.86), RED)
    axes.text(0.48, 0.8, "admit, or not?", fontsize=26, weight="bold", color=INK)


def pension(axes: Axes) -> None:
    """Draw the many clients of the pension fund, and the three who decide about them."""
    canvas(axes)
    places = np.random.default_rng(1).uniform((0.03, 0.03), (1.97, 0.36), (420, 2))
    axes.scatter(*places.T, s=28, color=BLUE, linewidths=0)
    for x, label, colour in (
        (0.05, "manager", GREEN),
        (0.7, "company", ORANGE),
        (1.35, "regulator", RED),
    ):
        box(axes, x, 0.66, 0.6, 0.27, colour)
        axes.text(x + 0.3, 0.79, label, fontsize=20, color="white", **MIDDLE)
        arrow(axes, (x + 0.3, 0.65), (x + 0.3, 0.38), colour)


def house(axes: Axes, x: float, y: float, colour: str) -> None:
    """Draw a small house."""
    axes.add_patch(Rectangle((x - 0.1, y - 0.08), 0.2, 0.15, color=colour, linewidth=0))
    axes.add_patch(
        Polygon(
            [(x - 0.14, y + 0.07), (x + 0.14, y + 0.07), (x, y + 0.2)], color=colour, linewidth=0
        )
    )


def town(axes: Axes) -> None:
    """Draw farms with their fields, the shops of the town, and the ways between them."""
    canvas(axes)
    shops = ((1.55, 0.7), (1.72, 0.22))
    for x, y in ((0.3, 0.7), (0.25, 0.17), (0.87, 0.43)):
        for shop in shops:
            axes.plot([x, shop[0]], [y, shop[1]], color=SILVER, linewidth=5, zorder=0)
        for row in range(3):
            axes.plot([x - 0.2, x + 0.2], [y - 0.02 - 0.06 * row] * 2, color=GREEN, linewidth=7)
        house(axes, x, y + 0.06, ORANGE)
    for shop in shops:
        house(axes, *shop, BLUE)


def room(axes: Axes) -> None:
    """Draw a room with a heater, and its thermometer."""
    canvas(axes)
    axes.add_patch(Polygon([(0.3, 0.6), (1, 0.97), (1.7, 0.6)], color=SILVER, linewidth=0))
    axes.add_patch(Rectangle((0.42, 0.05), 1.16, 0.55, color=PALE, linewidth=0))
    for number in range(4):
        box(axes, 0.52 + 0.11 * number, 0.11, 0.08, 0.24, RED)
    for number in range(3):
        x = 0.58 + 0.13 * number + 0.02 * np.sin(np.linspace(0, 9, 30))
        axes.plot(x, np.linspace(0.39, 0.55, 30), color=ORANGE, linewidth=5)
    axes.text(1.28, 0.3, "21 °C", fontsize=30, color=INK, **MIDDLE)


def follower(axes: Axes) -> None:
    """Draw the paths of a leader, and of a robot that follows it at a distance."""
    canvas(axes)
    x = np.linspace(0.1, 1.85, 100)
    y = 0.48 + 0.26 * np.sin(4.2 * x)
    axes.plot(x, y, color=SILVER, linewidth=8)
    axes.plot(x[:66], y[:66], color=BLUE, linewidth=8)
    for place, label, colour in ((-1, "leader", ORANGE), (65, "follower", BLUE)):
        disc(axes, x[place], y[place], 0.1, colour)
        height = y[place] + (0.15 if place < 0 else -0.22)
        axes.text(x[place] - 0.13, height, label, color=colour, ha="right", **BOLD)


def robots(axes: Axes) -> None:
    """Draw pairs of robots, where each goes, and obstacles."""
    canvas(axes)
    for x, y in ((0.75, 0.75), (1.2, 0.25), (1.75, 0.75)):
        axes.add_patch(Rectangle((x - 0.09, y - 0.09), 0.18, 0.18, color=SILVER, linewidth=0))
    for x, y, angle, colour in (
        (0.25, 0.75, -0.6, BLUE), (0.3, 0.25, 0.4, BLUE), (1.2, 0.68, -0.2, GREEN),
        (0.75, 0.3, 0.9, GREEN), (1.65, 0.3, 2.6, ORANGE),
    ):  # fmt: skip
        arrow(axes, (x, y), (x + 0.3 * np.cos(angle), y + 0.3 * np.sin(angle)), colour)
        disc(axes, x, y, 0.11, colour)


# -- the result of the demo -----------------------------------------------------------------------

TEAMS = {
    "rule": ("rule", GREY),
    "constant pair (84 l, 100 %)": ("constant", ORANGE),
    "both trained": ("trained", GREEN),
}
"""Teams of the demo, with the label and the colour of each."""


def of_demo(name: str) -> Any:
    """Return results of the demo: the returns, or the plants alive, of each team."""
    return json.loads(DEMO.read_text(encoding="utf-8"))[name]


def returns(axes: Axes) -> None:
    """Draw the mean return of each team."""
    values = of_demo("returns")
    for row, (title, (label, colour)) in enumerate(TEAMS.items()):
        mean = np.mean(values[title])
        axes.barh(-row, mean, 0.7, color=colour)
        axes.text(mean + 2, -row, f"{mean:.0f}", color=colour, fontsize=20, va="center")
        axes.text(-2, -row, label, color=colour, fontsize=20, va="center", ha="right")
    axes.set_title("return of the team", fontsize=20, color=INK)
    axes.set(xlim=(-36, 100))
    axes.axis("off")


def plants(axes: Axes) -> None:
    """Draw the plants alive on each day."""
    alive = of_demo("alive")
    for title, (_, colour) in TEAMS.items():
        axes.plot(np.mean(alive[title], axis=0), color=colour, linewidth=5)
    axes.set_title("plants alive, of 200", fontsize=20, color=INK)
    axes.set_xlabel("day", fontsize=18, color=INK)
    axes.tick_params(labelsize=16)
    axes.set(xticks=(0, 50, 100), yticks=(0, 100, 200))
    axes.spines[["top", "right"]].set_visible(False)


RESULT = {"result-returns": returns, "result-plants": plants}
PICTURES = {
    **RESULT,
    "template-plain": battery,
    "template-simpy": paint_shop,
    "template-mesa": rabbits,
    "greenhouse": greenhouse,
    "play": page_of_play,
    "market": traders,
    "mesa": mesa,
    "wolf-sheep": meadow,
    "queue": queue,
    "planning": futures,
    "matrix": matrix,
    "pension": pension,
    "town": town,
    "room": room,
    "follower": follower,
    "robots": robots,
}


def main() -> None:
    """Save the pictures."""
    for name in sys.argv[1:] or PICTURES:
        figure = new_figure(6.4, 3.2)
        figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.1)
        axes = figure.add_subplot()
        if name not in RESULT:
            axes.axis("off")
        PICTURES[name](axes)
        figure.savefig(HERE / "gallery" / f"{name}.png", dpi=100)


if __name__ == "__main__":
    main()
