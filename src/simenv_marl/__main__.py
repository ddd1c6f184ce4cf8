"""The command line: ``python -m simenv_marl new|check|inspect|play|serve|replay|wire-check``.

Exit codes: 0 for success; 1 if a check has found errors; 2 if an argument is invalid, the
simulation cannot be made, or a file cannot be written.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import pkgutil
import sys
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from .envs import single_env
from .errors import OptionValueError, SimEnvError, describe_error, did_you_mean, short_repr
from .simulation import Model
from .testing import CheckReport, Inspection, check_simulation, inspect_simulation
from .testing.templates import KINDS, write_template

if TYPE_CHECKING:
    from .remote.check import WireReport


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with arguments (default: of this process); return the exit code."""
    options = vars(_parser().parse_args(arguments))
    run = options.pop("run")
    as_json = options.pop("json", False)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        result = run(**options)
    except SimEnvError as error:
        print(f"simenv_marl: {error}", file=sys.stderr)
        return 2
    print(json.dumps(result.to_dict(), indent=2) if as_json else result)
    return 0 if getattr(result, "ok", True) else 1


def _parser() -> argparse.ArgumentParser:
    about = (
        "Write a template to start from; check, inspect, play or serve a simulation; repeat the"
        " episode of a file; test a simulator in another process."
    )
    parser = argparse.ArgumentParser(prog="python -m simenv_marl", description=about)
    commands = parser.add_subparsers(required=True, metavar=" | ".join(_COMMANDS))
    for name, (run, text, arguments) in _COMMANDS.items():
        command = commands.add_parser(name, help=text, description=f"{text.capitalize()}.")
        command.set_defaults(run=run)
        for argument, settings in arguments.items():
            command.add_argument(argument, **settings)
    return parser


# -- the commands ---------------------------------------------------------------------------------


def _check(simulation: str, points: list[str] | None, seed: int, **limits: Any) -> CheckReport:
    seeds = range(seed, seed + 3)
    return check_simulation(find_simulation(simulation), points, seeds=seeds, **limits)


def _inspect(simulation: str, points: list[str] | None, seed: int) -> Inspection:
    model = find_simulation(simulation)
    try:
        return inspect_simulation(model, points, seed=seed)
    except SimEnvError:
        raise
    except (Exception, SystemExit) as error:
        raise OptionValueError(f"{simulation} cannot be run: {describe_error(error)}") from error


def _play(
    simulation: str,
    seat: list[str],
    policy: list[str],
    max_steps: int | None,
    skip_forced: bool,
    **options: Any,
) -> str:
    from .seats.play.host import Rules
    from .seats.play.start import find_game, start

    # Not as a function of "__main__", because another process cannot import that.
    find = importlib.import_module(f"{__package__}.__main__").find_simulation
    given = {"max_steps": max_steps, "skip_forced": skip_forced}
    title = options.pop("title") or simulation.rpartition(":")[2]
    make = partial(
        find_game,
        find,
        simulation,
        policy,
        name=simulation,
        seats=seat,
        options={name: value for name, value in given.items() if value},
        rules=Rules(title, *(options.pop(name) for name in ("tools", "limit", "time_unit"))),
        **{name: options.pop(name) for name in ("seed", "new")},
        record=options["record"],
    )
    return start(make, **options)


def _serve(simulation: str, seat: str, port: int) -> str:
    from .seats.openenv import run

    make = partial(single_env, find_simulation(simulation), agent=seat)
    return run(make, simulation.rpartition(":")[2], port)


def _replay(file: Path, until: int | None, play: bool, port: int) -> str:
    if play:
        from .seats.play.host import Rules
        from .seats.play.start import open_game, start

        make = partial(open_game, file, until, Rules(""))
        return start(make, host="127.0.0.1", port=port, record=None)
    from .episodes import replay_episode

    return replay_episode(file, until)


def _wire_check(program: list[str], **limits: Any) -> WireReport:
    from .remote.check import check_wire

    command = program[1:] if program[:1] == ["--"] else program
    if not command:
        raise OptionValueError(
            "wire-check needs a command: the simulator's program and its arguments"
        )
    return check_wire(command, **limits)


def find_simulation(text: str) -> Model:
    """Import the object that ``module:name`` names.

    Raises:
        OptionValueError: There is no such object, or the module cannot be imported.
    """
    name, _, path = text.partition(":")
    if not (name and path):
        raise OptionValueError(
            f"{text!r} is not of the form module:Simulation, such as examples.shop:Shop"
        )
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise OptionValueError(_explain_missing(name, error.name or "")) from error
    except (Exception, SystemExit) as error:
        raise OptionValueError(
            f"the module {name!r} cannot be imported: {describe_error(error)}"
        ) from error
    try:
        return attrgetter(path)(module)
    except AttributeError as error:
        owner = getattr(error.obj, "__name__", short_repr(error.obj))
        hint = did_you_mean(error.name, dir(error.obj))
        raise OptionValueError(f"{owner} has no {error.name!r}{hint}") from None


def _explain_missing(name: str, missing: str) -> str:
    """Explain why a module cannot be imported, because another or itself is missing."""
    if not f"{name}.".startswith(f"{missing}."):
        return f"the module {name!r} needs {missing!r}, which is not installed"
    parent, _, last = missing.rpartition(".")
    folders = [os.getcwd()]
    if parent:
        folders = getattr(importlib.import_module(parent), "__path__", [parent])
    modules = [module.name for module in pkgutil.iter_modules(folders)]
    hint = did_you_mean(last, modules, f"{parent}." if parent else "")
    return f"there is no module {missing!r}{hint} (looked for in {folders[0]})"


# -- their arguments ------------------------------------------------------------------------------


def _json(text: str) -> dict[str, Any]:
    """Convert an argument to a dict."""
    try:
        value = json.loads(text)
    except ValueError:
        value = None
    if isinstance(value, dict):
        return value
    raise argparse.ArgumentTypeError(f"{text!r} is not a JSON object")


_Arguments = dict[str, dict[str, Any]]

_SIMULATION: Final[_Arguments] = {
    "simulation": {
        "metavar": "module:Simulation",
        "help": "a class, an instance, or a factory without arguments",
    },
}
_AS_JSON: Final[_Arguments] = {
    "--json": {"action": "store_true", "help": "print JSON instead of text"},
}
_PORT: Final[_Arguments] = {
    "--port": {
        "type": int,
        "default": 8000,
        "metavar": "P",
        "help": "where to serve it; 0: any free port (default: 8000)",
    },
}
_RUN: Final[_Arguments] = {
    **_SIMULATION,
    "--points": {
        "nargs": "+",
        "metavar": "NAME",
        "help": "decision points (default: the simulation's own)",
    },
    "--seed": {"type": int, "default": 0, "metavar": "N", "help": "the first seed (default: 0)"},
    **_AS_JSON,
}

_COMMANDS: Final[dict[str, tuple[Callable[..., object], str, _Arguments]]] = {
    "new": (
        write_template,
        "write a model to start from: one file with environment and training, and one with tests",
        {
            "kind": {
                "choices": KINDS,
                "help": "a plain loop, processes of SimPy, or agents of Mesa",
            },
            "name": {"metavar": "NAME", "help": "the module; its classes are named after it"},
            "--folder": {
                "type": Path,
                "metavar": "DIR",
                "help": "the folder for both files (default: a new folder NAME)",
            },
        },
    ),
    "check": (
        _check,
        "run a simulation alone and in environments, and report what is wrong",
        {
            **_RUN,
            "--episodes": {
                "type": int,
                "default": 10,
                "metavar": "N",
                "help": "random episodes (default: 10)",
            },
            "--max-steps": {
                "type": int,
                "default": 1000,
                "metavar": "N",
                "help": "the longest run, in decisions (default: 1000)",
            },
            "--time-limit": {
                "type": float,
                "default": 60.0,
                "metavar": "SECONDS",
                "help": "for the whole check (default: 60)",
            },
        },
    ),
    "inspect": (
        _inspect,
        "list the decision points of a simulation and the order of their calls",
        _RUN,
    ),
    "play": (
        _play,
        "serve a page on which people take agents' seats in a running simulation",
        {
            **_SIMULATION,
            "--seat": {
                "action": "extend",
                "nargs": "+",
                "default": [],
                "metavar": "AGENT",
                "help": "agents for people (default: all)",
            },
            "--seed": {
                "type": int,
                "metavar": "N",
                "help": "the seed of the first episode (default: a random one)",
            },
            **_PORT,
            "--host": {
                "default": "127.0.0.1",
                "help": "the address to listen on (default: 127.0.0.1, for this machine alone)",
            },
            "--limit": {
                "type": float,
                "metavar": "SECONDS",
                "help": "the time after which the rule decides (default: none)",
            },
            "--record": {
                "type": Path,
                "metavar": "FILE",
                "help": "append the decisions to a file of JSON lines; go on with its game if it"
                " exists",
            },
            "--new": {"action": "store_true", "help": "begin another game in an existing FILE"},
            "--policy": {
                "action": "extend",
                "nargs": "+",
                "default": [],
                "metavar": "AGENT=module:object",
                "help": "policies for agents; without AGENT=, a dict of policies",
            },
            "--max-steps": {
                "type": int,
                "metavar": "N",
                "help": "the number of decisions after which time is up (default: none)",
            },
            "--skip-forced": {
                "action": "store_true",
                "help": "do not ask where one action alone is legal",
            },
            "--title": {"default": "", "help": "the title of the page (default: the class)"},
            "--time-unit": {
                "default": "",
                "metavar": "UNIT",
                "help": "the unit of the simulation's time, in the singular, such as hour",
            },
            "--tools": {
                "choices": ("all", "facilitator", "none"),
                "default": "all",
                "help": "who may undo, jump, restart and let the rule play on (default: all)",
            },
        },
    ),
    "serve": (
        _serve,
        "serve an agent's seat as an OpenEnv environment, on the loopback address",
        {
            **_SIMULATION,
            "--seat": {"required": True, "metavar": "AGENT", "help": "the agent"},
            "--port": {
                "type": int,
                "default": 8000,
                "metavar": "P",
                "help": "where to serve it; 0: any free port (default: 8000)",
            },
        },
    ),
    "replay": (
        _replay,
        "repeat the episode of a file, and show its decisions or go on from there",
        {
            "file": {
                "type": Path,
                "metavar": "FILE",
                "help": "a file of save_episode, of the option record, or of `play --record`",
            },
            "--until": {
                "type": int,
                "metavar": "N",
                "help": "stop after N decisions (default: all of the file)",
            },
            "--play": {
                "action": "store_true",
                "help": "serve a page on which people go on from there",
            },
            **_PORT,
        },
    ),
    "wire-check": (
        _wire_check,
        "test a simulator in another process, and report what it does wrong",
        {
            "--seed": {
                "type": int,
                "default": 1,
                "metavar": "N",
                "help": "the seed of the episodes (default: 1)",
            },
            "--options": {
                "type": _json,
                "default": {},
                "metavar": "JSON",
                "help": "the options in the start message (default: {})",
            },
            "--decisions": {
                "type": int,
                "default": 1000,
                "metavar": "N",
                "help": "the longest episode (default: 1000)",
            },
            "--timeout": {
                "type": float,
                "default": 30.0,
                "metavar": "SECONDS",
                "help": "the longest wait for a line (default: 30)",
            },
            "program": {
                "nargs": argparse.REMAINDER,
                "metavar": "COMMAND",
                "help": "the program and its arguments",
            },
            **_AS_JSON,
        },
    ),
}
"""The function, the description and the arguments of each command, as ``argparse`` takes them."""


if __name__ == "__main__":
    sys.exit(main())
