"""The command line: ``python -m simenv_marl`` with ``new``, ``check``, ``inspect`` or ``wire-check``.

Exit codes: 0 for success; 1 if a check has found errors (or the model fails in ``inspect``); 2 if the arguments cannot
be used, or nothing can be written.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import pkgutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .errors import SimEnvError, describe_error, did_you_mean
from .testing.templates import KINDS, write_template


class _UsageError(Exception):
    """The arguments cannot be used."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: The arguments after the program's name. None: those of this process.

    Returns:
        The exit code.
    """
    options = _parser().parse_args(arguments)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        seen = options.look(options)
    except (_UsageError, SimEnvError) as error:
        print(f"simenv_marl: {error}", file=sys.stderr)
        return 2
    print(json.dumps(seen.to_dict(), indent=2) if options.json else seen)
    return 0 if getattr(seen, "ok", True) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simenv_marl",
        description="Write a template to start from, check a simulation, list its decision points, or test a simulator"
        " in another process.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="new | check | inspect | wire-check")
    _add_new(commands)
    check = commands.add_parser(
        "check",
        help="run a simulation alone and in environments, and report what is wrong",
        description="Run a simulation alone and in environments, and report what is wrong. Exit code: 0 without errors,"
        " 1 with errors, 2 if the simulation cannot run.",
    )
    look = commands.add_parser(
        "inspect",
        help="list the decision points of a simulation and the order of their calls",
        description="List the decision points of a simulation, and the order in which the model calls them.",
    )
    check.set_defaults(look=_checked)
    look.set_defaults(look=_inspected)
    for command in (check, look):
        command.add_argument(
            "simulation", metavar="module:Simulation", help="a class, an instance, or a factory without arguments"
        )
        command.add_argument(
            "--points",
            nargs="+",
            metavar="NAME",
            help="dotted names of decision points (default: the simulation's own)",
        )
        command.add_argument("--seed", type=_number(0), default=0, metavar="N", help="the first seed (default: 0)")
        command.add_argument("--json", action="store_true", help="print JSON instead of text")
    check.add_argument("--episodes", type=_number(1), default=10, metavar="N", help="random episodes (default: 10)")
    check.add_argument(
        "--max-steps", type=_number(1), default=1000, metavar="N", help="the longest run, in decisions (default: 1000)"
    )
    check.add_argument(
        "--time-limit", type=_seconds, default=60.0, metavar="SECONDS", help="for the whole check (default: 60)"
    )
    _add_wire_check(commands)
    return parser


def _add_new(commands: Any) -> None:
    new = commands.add_parser(
        "new",
        help="write a model to start from, with environment, training and tests",
        description="Write one file with a model, its environment and its training, and a file with its tests.",
    )
    new.set_defaults(look=lambda options: write_template(options.kind, options.name, options.folder), json=False)
    new.add_argument("kind", choices=KINDS, help="a plain loop, processes of SimPy, or agents of Mesa")
    new.add_argument("name", metavar="NAME", help="the module; its class is named after it")
    new.add_argument(
        "--folder", type=Path, metavar="DIR", help="the folder for both files (default: a new folder NAME)"
    )


def _add_wire_check(commands: Any) -> None:
    wire = commands.add_parser(
        "wire-check",
        help="test a simulator in another process, and report what it does wrong",
        description="Test a simulator that speaks the wire, and report what it does wrong. Exit code: 0 if nothing is"
        " wrong, otherwise 1.",
    )
    wire.set_defaults(look=_wire_checked)
    wire.add_argument("--seed", type=_number(0), default=1, metavar="N", help="the seed of the episodes (default: 1)")
    wire.add_argument(
        "--options", type=_json, default={}, metavar="JSON", help="the options in the start message (default: {})"
    )
    wire.add_argument(
        "--decisions",
        type=_number(1),
        default=1000,
        metavar="N",
        help="stop an episode after so many decisions (default: 1000)",
    )
    wire.add_argument(
        "--timeout", type=_seconds, default=30.0, metavar="SECONDS", help="the longest wait for a line (default: 30)"
    )
    wire.add_argument("--json", action="store_true", help="print JSON instead of text")
    wire.add_argument("program", metavar="COMMAND", nargs=argparse.REMAINDER, help="the program and its arguments")


def _number(least: int) -> Any:
    def number(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
        return int(text)

    return number


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
    return seconds


def _json(text: str) -> Any:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not JSON: {error}") from None
    if not isinstance(found, dict):
        raise argparse.ArgumentTypeError(f"{text!r} is not a JSON object")
    return found


def _wire_checked(options: argparse.Namespace) -> Any:
    from .remote.check import check_wire

    program = options.program[1:] if options.program[:1] == ["--"] else options.program
    if not program:
        raise _UsageError("wire-check needs a command: the simulator's program and its arguments")
    return check_wire(
        program, options=options.options, seed=options.seed, decisions=options.decisions, timeout=options.timeout
    )


def _checked(options: argparse.Namespace) -> Any:
    from .testing import check_simulation

    return check_simulation(
        _found(options.simulation),
        options.points,
        seeds=range(options.seed, options.seed + 3),
        episodes=options.episodes,
        max_steps=options.max_steps,
        time_limit=options.time_limit,
    )


def _inspected(options: argparse.Namespace) -> Any:
    from .testing import inspect_simulation

    simulation = _found(options.simulation)
    try:
        return inspect_simulation(simulation, options.points, seed=options.seed)
    except SimEnvError:
        raise
    except Exception as error:
        raise _UsageError(f"{options.simulation} cannot be run: {describe_error(error)}") from error


def _found(text: str) -> Any:
    """Import the object that ``module:name`` names.

    Raises:
        _UsageError: It does not exist.
    """
    module_name, colon, path = text.partition(":")
    if not (module_name and colon and path):
        raise _UsageError(f"{text!r} is not of the form module:Simulation, such as examples.shop:Shop")
    found: Any = _module(module_name)
    for name in path.split("."):
        try:
            found = getattr(found, name)
        except AttributeError:
            raise _UsageError(
                f"{getattr(found, '__name__', found)} has no {name!r}{_alternatives(name, found)}"
            ) from None
    return found


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise _UsageError(f"the module {name!r} needs {error.name!r}, which is not installed") from error
        parent, _, last = error.name.rpartition(".")
        where = importlib.import_module(parent).__path__ if parent else None
        if where is None and parent == "":
            where = [os.getcwd()]
        known = [module.name for module in pkgutil.iter_modules(where)]
        hint = did_you_mean(last, known, f"{parent}." if parent else "")
        raise _UsageError(
            f"there is no module {error.name!r}{hint} (looked for in {os.getcwd()} and on Python's path)"
        ) from None
    except Exception as error:
        raise _UsageError(f"the module {name!r} cannot be imported: {describe_error(error)}") from error


def _alternatives(name: str, owner: Any) -> str:
    hint = did_you_mean(name, dir(owner))
    if hint:
        return hint
    runnable = [
        other
        for other, value in vars(owner).items()
        if inspect.isclass(value) and hasattr(value, "run") and hasattr(value, "reset")
    ]
    return f"; it has the simulations {', '.join(runnable)}" if runnable else ""


if __name__ == "__main__":
    sys.exit(main())
