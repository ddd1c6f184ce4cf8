"""Draw the plots of the pages ``experiments.md`` and ``ledger.md``.

``python docs/figures/looking.py`` runs the examples of both.
"""

from __future__ import annotations

import sys
from doctest import DocTestParser
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from simenv_marl import RULE, TRUNCATED, difference, make_step
from simenv_marl.data import collect_episodes, plot_timeline

HERE = Path(__file__).parent

POINTS = {
    "lake.Boat.choose_catch": make_step(
        observation_space=spaces.Box(0, 100, (2,), np.float32),
        observation_space_mapping=lambda boat: [boat.lake.fish, boat.cash],
        action_space=spaces.Discrete(5),
        action_space_mapping=lambda action: action,
        rule_action_mapping=lambda fish: fish,
        reward_mapping=difference(lambda boat: boat.cash),
        agent=lambda boat: boat.name,
        removed_by={"lake.Lake.lay_up": lambda lake, boat: boat.name},
    )
}


class Years:
    """Sixty years on the lake."""

    def reset(self) -> None:
        """Fill the lake."""
        from lake import Lake

        self.lake = Lake()

    def time(self) -> int:
        """Return the year."""
        return self.lake.year

    def run(self) -> Any:
        """Simulate the years."""
        while self.lake.year < 60:
            self.lake.update_year()
        return TRUNCATED


def boats() -> Any:
    """Draw boats that explore as long as there are fish; rich boats follow the rule."""
    generator = np.random.default_rng(1)

    def trying(observations: Any) -> list[Any]:
        fish, cash = observations.T
        tried = np.where(fish > 8, generator.choice([0, 0, 1, 3], len(fish)), 0)
        return [RULE if rich else catch for rich, catch in zip(cash > 5, tried, strict=True)]

    return plot_timeline(
        collect_episodes(Years, dict.fromkeys(POINTS, trying), points=POINTS, seeds=[0])
    )


def names_of(page: str) -> dict[str, Any]:
    """Run the examples of a page. Return their names."""
    names: dict[str, Any] = {"__name__": "__main__"}
    text = (HERE.parent / page).read_text(encoding="utf-8")
    for example in DocTestParser().get_examples(text):
        exec(compile(example.source, page, "exec"), names)
    return names


def main() -> None:
    """Run the examples of the pages, and save their figures and that of the boats."""
    sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]  # models, and examples
    names = names_of("experiments.md") | {"lake": boats()}
    for name in ("shop", "lake", "returns"):
        names[name].savefig(HERE / f"looking-{name}.png", dpi=100)
    names_of("ledger.md")["figure"].savefig(HERE / "ledger.png", dpi=100)


if __name__ == "__main__":
    main()
