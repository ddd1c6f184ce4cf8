"""The cost of handlers for functions without one, for functions with another environment's handler, and with one.

Run it with ``make benchmark``, or alone with ``python -m benchmarks.core --only plugins``. The comparison is with a
plain call that does nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE, State
from benchmarks.measure import Contender, Section, ratio, side_by_side, timed
from simenv_marl import make_step, single_env
from simenv_marl.plugins import ChangedResult, expose_to_plugins, handlers

DEFINITION: dict[str, Any] = {
    "observation_space": OBSERVATION_SPACE,
    "observation_space_mapping": lambda model: model.observe(),
    "action_space": ACTION_SPACE,
    "action_space_mapping": lambda action: action,
    "reward_mapping": lambda model: 1.0,
}


class Model(State):
    """Functions that do nothing, plain and exposed."""

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


def nothing(model: Model) -> None: ...


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of calls of each contender."""
    section, model = Section("Plugins", "microseconds per call, and per step"), Model()
    other = single_env(Model, Model.decide, plugins=[(nothing, Model.others, "before")])
    attached = handlers(
        (nothing, Model.one_before, "before"),
        (lambda model, _result: ChangedResult(None), Model.one_after, "after"),
        (nothing, Model.one_instead, "instead"),
    )
    functions = {
        "a plain call": model.plain,
        "exposed, no handlers": model.none,
        "exposed, another environment has a handler": model.others,
        "exposed, one handler before": model.one_before,
        "exposed, one handler after, which changes the result": model.one_after,
        "exposed, one handler instead": model.one_instead,
        "a decision function": model.decide,
        "a decision function, exposed": model.decide_exposed,
    }
    contenders = {name: calls(function, number) for name, function in functions.items()}
    contenders["a plain call, an argument"] = calls(model.plain_of, number, 1.0)
    contenders["exposed, no handlers, an argument"] = calls(model.none_of, number, 1.0)
    with attached:
        times = side_by_side(contenders, rounds)
    other.close()
    bars = {
        "exposed, no handlers": (3.0, 2.0),
        "exposed, no handlers, an argument": (3.0, 2.0),
        "exposed, another environment has a handler": (8.0, None),
    }
    for name in contenders:
        if name.startswith("a plain call"):
            continue
        under = "a plain call, an argument" if name.endswith("an argument") else "a plain call"
        section.ratio(f"{name} / {under}", ratio(times, name, under), *bars.get(name, ()))
    section.times(times)
    envs = {
        "step": single_env(Model, Model.decide),
        "step, a plugin that is not called": single_env(
            Model, Model.decide, plugins=[(nothing, Model.others, "before")]
        ),
        "step, a plugin on the decision": single_env(
            Model, Model.decide, plugins=[(nothing, f"{__name__}.Model.decide", "before")]
        ),
    }
    times = side_by_side({name: steps(env, max(number // 10, 1)) for name, env in envs.items()}, rounds)
    for name, env in envs.items():
        if name != "step":
            section.ratio(f"{name} / step", ratio(times, name, "step"))
        env.close()
    section.times(times)
    return section
