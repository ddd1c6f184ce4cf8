"""Environments made from the agency of ``model``. The model itself does not refer to this module.

- ``CASES``: each debtor is an agent, from the first decision on its case until the case is closed.
  All agents have the same spaces, so they can share one policy. The reward is the debtor's payments
  less the costs of the case.
- ``COLLECTOR``: one agent, ``collector_0``, decides on all cases. The reward is the agency's
  profit.
- ``NAMED_CASES`` and ``NAMED_COLLECTOR``: the same with fixed actions, those of ``CHOICES``, and a
  mask.
- ``CollectionSim``: the simulation: an agency over a number of days.

In the first two, the action is an index into the lawful choices that the call gets, so 2 can mean
"call" today and "sue" tomorrow. The last three numbers of an observation tell which choices are
lawful, and ``lawful`` lists them. In the parallel view, the lawful choices can change between the
observation and the decision: use fixed actions there.

Rewards are in hundreds of dollars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from simenv_marl import (
    TRUNCATED,
    Definition,
    SimulationInterface,
    difference,
    make_step,
    reseed_generators,
)

from .model import ACTIVE, CHOICES, KEPT, Agency, Debtor, Parameters

DAYS: Final = 720
"""The number of days after which an episode is truncated."""

POINT: Final = f"{Agency.__module__}.Agency.choose_contact"
"""The decision point."""

OBSERVED: Final = {
    "what is owed, in thousands": 100,
    "age of the debt, in years": 20,
    "years until the case is written off": 1,
    "letters sent": 50,
    "calls made": 500,
    "weeks since the latest letter or call": 10,
    "whether there was a conversation": 1,
    "whether a plan was broken": 1,
    "share of today's calls that is left": 1,
    "other cases that are due today": 1000,
    "whether to write is lawful": 1,
    "whether to call is lawful": 1,
    "whether to sue is lawful": 1,
}
"""The observation of a case: what a collector can know. The numbers are the upper bounds."""

HIGH: Final = np.array(list(OBSERVED.values()), np.float32)
SPACE: Final = Box(np.zeros(len(HIGH), np.float32), HIGH)


def observe(agency: Agency, debtor: Debtor, choices: Sequence[str]) -> NDArray[np.float32]:
    """Observe a case, as ``OBSERVED`` lists it."""
    day, latest = agency.world.month, debtor.contacted
    seen = (
        debtor.balance / 1000_00,
        debtor.age / 365,
        max(1 - (day - debtor.arrived) / KEPT, 0.0),
        debtor.letters,
        debtor.attempts,
        HIGH[5] if latest is None else (day - latest) / 7,
        debtor.talked is not None,
        debtor.contract is not None,
        agency.calls_left / max(agency.parameters.calls, 1),
        len(agency.queue),
        *(choice in choices for choice in CHOICES[1:]),
    )
    return np.minimum(np.array(seen, np.float32), HIGH)


def lawful(observation: Any) -> list[str]:
    """Read the lawful choices from an observation, in the order of the action's index."""
    flags = (1.0, *observation[1 - len(CHOICES) :])
    return [choice for choice, flag in zip(CHOICES, flags, strict=True) if flag]


def profit_of_case(agency: Agency, debtor: Debtor, choices: Sequence[str]) -> float:
    """The debtor's payments less the costs of the case, in hundreds of dollars."""
    return (debtor.collected - debtor.spent) / 100_00


def profit(agency: Agency) -> float:
    """The agency's profit, in hundreds of dollars."""
    return agency.profit / 100_00


gain_of_case: Final = difference(profit_of_case)
gain: Final = difference(profit)


def offered(agency: Agency, debtor: Debtor, choices: Sequence[str]) -> Sequence[str]:
    """Return the choices of a call."""
    return choices


def mask(agency: Agency, debtor: Debtor, choices: Sequence[str]) -> list[bool]:
    """Mask what is not lawful."""
    return [choice in choices for choice in CHOICES]


def number_of(choice: str, agency: Agency, debtor: Debtor, choices: Sequence[str]) -> int:
    """Map the rule's choice to its action."""
    return choices.index(choice)


def agent_of(agency: Agency, debtor: Debtor, choices: Sequence[str]) -> str:
    """Name a debtor's agent."""
    return debtor.name


def closed(debtor: Debtor, reason: str) -> str:
    """Name the agent of a debtor whose case is closed."""
    return debtor.name


CASE: Final = make_step(
    observation_space=SPACE,
    observation_space_mapping=observe,
    action_space=Discrete(len(CHOICES)),
    choices=offered,
    rule_action_mapping=number_of,
    reward_mapping=gain_of_case,
    agent=agent_of,
    removed_by={f"{Debtor.__module__}.Debtor.close": closed},
)


def named(definition: Definition) -> Definition:
    """Change a definition to the fixed actions ``CHOICES``, with a mask of the lawful ones."""
    return replace(
        definition,
        choices=None,
        action_space_mapping=CHOICES.__getitem__,
        rule_action_mapping={choice: action for action, choice in enumerate(CHOICES)},
        action_mask_mapping=mask,
    )


CASES: Final[dict[Any, Definition]] = {POINT: CASE}
"""One agent per debtor."""

COLLECTOR: Final[dict[Any, Definition]] = {
    POINT: replace(CASE, reward_mapping=gain, agent="collector_0", removed_by={}),
}
"""One agent for all cases."""

NAMED_CASES: Final[dict[Any, Definition]] = {POINT: named(CASES[POINT])}
"""One agent per debtor, with fixed actions."""

NAMED_COLLECTOR: Final[dict[Any, Definition]] = {POINT: named(COLLECTOR[POINT])}
"""One agent for all cases, with fixed actions."""


class CollectionSim(SimulationInterface):
    """An agency over a number of days.

    Attributes:
        agency: The agency of the current episode.
    """

    points = CASES

    def __init__(self, days: int = DAYS, parameters: Parameters | None = None) -> None:
        """Make a simulation.

        Args:
            days: The number of days after which an episode is truncated.
            parameters: The agency's parameters; None: the model's defaults.
        """
        self.days = days
        self.parameters = parameters or Parameters()
        self.agency = Agency(0, self.parameters)
        self._stopped = False

    def reset(self, seed: int | None = None) -> None:
        """Create a new agency."""
        self._stopped = False
        self.agency = Agency(seed, self.parameters)

    def run(self) -> Any:
        """Simulate days until all cases are closed and the agency buys no more debts.

        Returns:
            ``TRUNCATED`` if the last day comes first, else None.
        """
        agency = self.agency
        while agency.world.month < self.days and not self._stopped:
            if not agency.cases and agency.world.month >= self.parameters.buying:
                break
            agency.advance()
        else:
            return None if self._stopped else TRUNCATED
        return None

    def stop(self) -> None:
        """Ask the loop to end after the current day."""
        self._stopped = True

    def time(self) -> int:
        """The time in days."""
        return self.agency.world.month

    def reseed(self, seed: int) -> None:
        """Draw another future for the present debtors and, by the world's seed, for later ones."""
        self.agency.world.seed = seed
        reseed_generators(self, seed)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the calls for the cases still due today."""
        return [(self.agency, debtor, self.agency.lawful(debtor)) for debtor in self.agency.queue]

    def state(self) -> NDArray[np.float32]:
        """Summarise all cases, with the debtors' money and willingness.

        The agency knows neither their money nor their willingness.
        """
        agency = self.agency
        cases = list(agency.cases.values())
        statuses = [debtor.status for debtor in cases]
        numbers = (
            self.time() / self.days,
            agency.profit / 10_000_00,
            agency.calls_left / max(agency.parameters.calls, 1),
            len(agency.queue) / 10,
            *(statuses.count(status) / 100 for status in ACTIVE),
            sum(debtor.balance for debtor in cases) / 100_000_00,
            sum(debtor.cents for debtor in cases) / 100_000_00,
            sum(debtor.willingness for debtor in cases) / 100,
        )
        return np.array(numbers, np.float32)


STATE_SPACE: Final = Box(-np.inf, np.inf, (12,), np.float32)
"""The space of the state: pass it as ``state_space=``."""
