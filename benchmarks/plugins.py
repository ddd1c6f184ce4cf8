"""The cost of handlers for functions with none, with another environment's, and with their own."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.hand_written import State
from benchmarks.measure import Group, Row, calls
from benchmarks.noop import DEFINITION, single
from simenv_marl import make_step, single_env
from simenv_marl.plugins import ChangedResult, expose_to_plugins, handlers


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

    def reset(self) -> None: ...

    def run(self) -> None:
        while True:
            self.decide()


def nothing(model: Model) -> None: ...


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a number of calls of each contender."""
    model = Model()
    other = single_env(Model, Model.decide, plugins=[(nothing, Model.others, "before")])
    plain, plain_of = calls(model.plain, number), calls(model.plain_of, number, 1.0)
    functions = {
        "exposed, no handlers": (model.none, 3.0, 2.0),
        "exposed, another environment has a handler": (model.others, 8.0),
        "exposed, one handler before": (model.one_before,),
        "exposed, one handler after, which changes the result": (model.one_after,),
        "exposed, one handler instead": (model.one_instead,),
    }
    rows = [
        Row(f"{name} / a plain call", calls(function, number), plain, *limits)
        for name, (function, *limits) in functions.items()
    ]
    none_of = calls(model.none_of, number, 1.0)
    rows.append(
        Row(
            "exposed, no handlers, an argument / a plain call, an argument",
            none_of,
            plain_of,
            3.0,
            2.0,
        )
    )
    with handlers(
        (nothing, Model.one_before, "before"),
        (lambda model, _result: ChangedResult(None), Model.one_after, "after"),
        (nothing, Model.one_instead, "instead"),
    ):
        yield Group(rows)
    other.close()

    plugins = {"that is not called": Model.others, "on the decision": f"{__name__}.Model.decide"}
    number = max(number // 10, 1)
    env = single_env(Model, Model.decide)
    without = single(env, number)
    envs = {
        name: single_env(Model, Model.decide, plugins=[(nothing, target, "before")])
        for name, target in plugins.items()
    }
    yield Group(
        [
            Row(f"a step, a plugin {name} / a step", single(env, number), without)
            for name, env in envs.items()
        ]
    )
    for each in (env, *envs.values()):
        each.close()
