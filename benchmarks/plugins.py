"""What handlers cost those who have none, those whose neighbours have some, and those who have one.

Run with ``python -m benchmarks.plugins``, best pinned to one core. Everything is compared to a plain call that
does nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE, State
from benchmarks.measure import Contender, Report, ratio, side_by_side, timed
from simenv_marl import ChangedResult, expose_to_plugins, handlers, make_step, single_env

DEFINITION: dict[str, Any] = {
    "observation_space": OBSERVATION_SPACE,
    "observation_space_mapping": lambda model: model.observe(),
    "action_space": ACTION_SPACE,
    "action_space_mapping": lambda action: action,
    "reward_mapping": lambda model: 1.0,
}


class Model(State):
    """Functions that do nothing, as they are and exposed."""

    def plain(self) -> None: ...

    def plain_of(self, amount: float) -> None: ...

    @expose_to_plugins
    def none(self) -> None: ...

    @expose_to_plugins
    def none_of(self, amount: float) -> None: ...

    @expose_to_plugins
    def others(self) -> None: ...

    @expose_to_plugins
    def one_before(self) -> None: ...

    @expose_to_plugins
    def one_after(self) -> None: ...

    @expose_to_plugins
    def one_instead(self) -> None: ...

    @make_step(**DEFINITION)
    def decide(self) -> int:
        return 0

    @expose_to_plugins
    @make_step(**DEFINITION)
    def decide_exposed(self) -> int:
        return 0

    def reset(self) -> None: ...

    def run(self) -> None:
        while True:
            self.decide()


def calls(function: Callable[..., Any], number: int, *args: Any) -> Contender:
    def loop(number: int) -> None:
        for _ in range(number):
            function(*args)

    def loop_without(number: int) -> None:
        for _ in range(number):
            function()

    def loop_of_one(number: int) -> None:
        (arg,) = args
        for _ in range(number):
            function(arg)

    return timed({0: loop_without, 1: loop_of_one}.get(len(args), loop), number)


def steps(env: Any, number: int) -> Contender:
    env.reset(seed=0)

    def loop(number: int) -> None:
        step = env.step
        for _ in range(number):
            step(1)

    return timed(loop, number)


CALLS = {
    "plain": "a plain call",
    "none": "exposed, no handlers",
    "none_of": "exposed, no handlers, an argument (over a plain call with one)",
    "others": "another environment has a handler",
    "one_before": "one handler before",
    "one_after": "one handler after, which asks for the result and changes it",
    "one_instead": "one handler instead",
    "decide": "a decision function outside any environment",
    "decide_exposed": "the same, exposed",
}


def nothing(model: Model) -> None: ...


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--number", type=int, default=20_000)
    parser.add_argument("--output", type=Path, help="where to write the tables, in Markdown")
    asked = parser.parse_args()
    model, report = Model(), Report("Plugins")
    name = f"{__name__}.Model"
    other = single_env(Model, Model.decide, plugins=[(nothing, Model.others, "before")])
    with ExitStack() as stack:
        stack.callback(other.close)
        stack.enter_context(
            handlers(
                (nothing, Model.one_before, "before"),
                (lambda model, _result: ChangedResult(None), Model.one_after, "after"),
                (nothing, Model.one_instead, "instead"),
            )
        )
        contenders = {case: calls(getattr(model, case), asked.number) for case in CALLS if case != "none_of"}
        contenders["plain_of"] = calls(model.plain_of, asked.number, 1.0)
        contenders["none_of"] = calls(model.none_of, asked.number, 1.0)
        times = side_by_side(contenders, asked.rounds)
    report.table(
        "Calls of functions that do nothing",
        ["call", "us", "plain calls"],
        [
            [
                text,
                f"{median(times[case]):.3f}",
                f"{ratio(times, case, 'plain_of' if case == 'none_of' else 'plain'):.2f}",
            ]
            for case, text in CALLS.items()
        ],
    )
    envs = {
        "no plugins": single_env(Model, Model.decide),
        "plugins, on a function that is not called": single_env(
            Model, Model.decide, plugins=[(nothing, Model.others, "before")]
        ),
        "plugins, on the decision": single_env(Model, Model.decide, plugins=[(nothing, f"{name}.decide", "before")]),
    }
    number = max(asked.number // 10, 1)
    times = side_by_side({text: steps(env, number) for text, env in envs.items()}, asked.rounds)
    report.table(
        "Steps of an environment",
        ["environment", "us", "of that without"],
        [[text, f"{median(times[text]):.3f}", f"{ratio(times, text, 'no plugins'):.2f}"] for text in envs],
    )
    for env in envs.values():
        env.close()
    if asked.output is not None:
        report.write(asked.output)


if __name__ == "__main__":
    main()
