"""The command line: ``python -m simenv_marl`` with ``new``, ``check``, ``inspect``, ``play`` or ``wire-check``.

Exit codes: 0 for success; 1 if a check has found errors (or the model fails in ``inspect``); 2 if
the arguments cannot be used, or nothing can be written.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import pkgutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from .errors import OptionValueError, SimEnvError, describe_error, did_you_mean, short_repr
from .testing.templates import KINDS, write_template


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, or with those of this process, and return the exit code."""
    options = _parser().parse_args(arguments)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        result = options.run(options)
    except SimEnvError as error:
        print(f"simenv_marl: {error}", file=sys.stderr)
        return 2
    print(json.dumps(result.to_dict(), indent=2) if getattr(options, "json", False) else result)
    return 0 if getattr(result, "ok", True) else 1


def _parser() -> argparse.ArgumentParser:
    about = "Write a template to start from; check, inspect or play a simulation; test a simulator in another process."
    parser = argparse.ArgumentParser(prog="python -m simenv_marl", description=about)
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="new | check | inspect | play | wire-check"
    )

    def add(name: str, run: Callable[[argparse.Namespace], Any], text: str) -> Any:
        command = commands.add_parser(name, help=text, description=f"{text.capitalize()}.")
        command.set_defaults(run=run)
        return command.add_argument

    new = add(
        "new",
        _new,
        "write a model to start from: one file with environment and training, and one with tests",
    )
    new("kind", choices=KINDS, help="a plain loop, processes of SimPy, or agents of Mesa")
    new("name", metavar="NAME", help="the module; its classes are named after it")
    new(
        "--folder",
        type=Path,
        metavar="DIR",
        help="the folder for both files (default: a new folder NAME)",
    )
    check = add(
        "check", _check, "run a simulation alone and in environments, and report what is wrong"
    )
    inspect = add(
        "inspect", _inspect, "list the decision points of a simulation and the order of their calls"
    )
    play = add(
        "play", _play, "serve a page on which people take agents' seats in a running simulation"
    )
    for command in (check, inspect, play):
        command(
            "simulation",
            metavar="module:Simulation",
            help="a class, an instance, or a factory without arguments",
        )
    for command in (check, inspect):
        command(
            "--points",
            nargs="+",
            metavar="NAME",
            help="decision points (default: the simulation's own)",
        )
        command("--seed", type=int, default=0, metavar="N", help="the first seed (default: 0)")
    check("--episodes", type=int, default=10, metavar="N", help="random episodes (default: 10)")
    check(
        "--max-steps",
        type=int,
        default=1000,
        metavar="N",
        help="the longest run, in decisions (default: 1000)",
    )
    check(
        "--time-limit",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="for the whole check (default: 60)",
    )
    play(
        "--seat",
        action="extend",
        nargs="+",
        default=[],
        metavar="AGENT",
        help="agents for people (default: all)",
    )
    play(
        "--seed",
        type=int,
        metavar="N",
        help="the seed of the first episode (default: a random one)",
    )
    play(
        "--port",
        type=int,
        default=8000,
        metavar="P",
        help="where to serve it; 0: any free port (default: 8000)",
    )
    play(
        "--host",
        default="127.0.0.1",
        help="the address to listen on (default: 127.0.0.1, for this machine alone)",
    )
    play(
        "--limit",
        type=float,
        metavar="SECONDS",
        help="the time after which the rule decides (default: none)",
    )
    play(
        "--record", type=Path, metavar="FILE", help="append what is decided to a file of JSON lines"
    )
    wire = add(
        "wire-check",
        _wire_check,
        "test a simulator in another process, and report what it does wrong",
    )
    wire("--seed", type=int, default=1, metavar="N", help="the seed of the episodes (default: 1)")
    wire(
        "--options",
        type=_json,
        default={},
        metavar="JSON",
        help="the options in the start message (default: {})",
    )
    wire(
        "--decisions",
        type=int,
        default=1000,
        metavar="N",
        help="the longest episode (default: 1000)",
    )
    wire(
        "--timeout",
        type=float,
        default=30.0,
        metavar="SECONDS",
        help="the longest wait for a line (default: 30)",
    )
    wire(
        "program", metavar="COMMAND", nargs=argparse.REMAINDER, help="the program and its arguments"
    )
    for command in (check, inspect, wire):
        command("--json", action="store_true", help="print JSON instead of text")
    return parser


def _json(text: str) -> dict[str, Any]:
    """Convert an argument to a dict."""
    with suppress(ValueError):
        if isinstance(value := json.loads(text), dict):
            return value
    raise argparse.ArgumentTypeError(f"{text!r} is not a JSON object")


def _new(options: argparse.Namespace) -> str:
    return write_template(options.kind, options.name, options.folder)


def _wire_check(options: argparse.Namespace) -> Any:
    from .remote.check import check_wire

    program = options.program[1:] if options.program[:1] == ["--"] else options.program
    if not program:
        raise OptionValueError(
            "wire-check needs a command: the simulator's program and its arguments"
        )
    limits = {"decisions": options.decisions, "timeout": options.timeout}
    return check_wire(program, options=options.options, seed=options.seed, **limits)


def _check(options: argparse.Namespace) -> Any:
    from .testing import check_simulation

    seeds = range(options.seed, options.seed + 3)
    extent = {
        "episodes": options.episodes,
        "max_steps": options.max_steps,
        "time_limit": options.time_limit,
    }
    return check_simulation(_find(options.simulation), options.points, seeds=seeds, **extent)


def _inspect(options: argparse.Namespace) -> Any:
    from .testing import inspect_simulation

    simulation = _find(options.simulation)
    try:
        return inspect_simulation(simulation, options.points, seed=options.seed)
    except SimEnvError:
        raise
    except (Exception, SystemExit) as error:
        raise OptionValueError(
            f"{options.simulation} cannot be run: {describe_error(error)}"
        ) from error


def _play(options: argparse.Namespace) -> str:
    from .many.parallel import import_extra

    for package in ("starlette", "uvicorn", "websockets"):
        import_extra(package, "play")
    from .seats.play.server import play

    names = ("seed", "host", "port", "limit", "record")
    arguments = {name: getattr(options, name) for name in names}
    # by a name that another process can import
    find = importlib.import_module(f"{__package__}.__main__")._find
    return play(
        partial(find, options.simulation), name=options.simulation, seats=options.seat, **arguments
    )


def _find(text: str) -> Any:
    """Import the object that ``module:name`` names, or raise ``OptionValueError``."""
    name, _, path = text.partition(":")
    if not (name and path):
        raise OptionValueError(
            f"{text!r} is not of the form module:Simulation, such as examples.shop:Shop"
        )
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if not f"{name}.".startswith(f"{missing}."):
            raise OptionValueError(
                f"the module {name!r} needs {missing!r}, which is not installed"
            ) from error
        parent, _, last = missing.rpartition(".")
        folders = (
            getattr(importlib.import_module(parent), "__path__", [parent])
            if parent
            else [os.getcwd()]
        )
        modules = [module.name for module in pkgutil.iter_modules(folders)]
        hint = did_you_mean(last, modules, f"{parent}." if parent else "")
        raise OptionValueError(
            f"there is no module {missing!r}{hint} (looked for in {folders[0]})"
        ) from None
    except (Exception, SystemExit) as error:
        raise OptionValueError(
            f"the module {name!r} cannot be imported: {describe_error(error)}"
        ) from error
    try:
        return attrgetter(path)(module)
    except AttributeError as error:
        hint = did_you_mean(error.name, dir(error.obj))
        raise OptionValueError(
            f"{getattr(error.obj, '__name__', short_repr(error.obj))} has no {error.name!r}{hint}"
        ) from None
    except Exception as error:
        raise OptionValueError(f"{text} cannot be imported: {describe_error(error)}") from error


if __name__ == "__main__":
    sys.exit(main())
