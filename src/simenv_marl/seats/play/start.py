"""The function ``play``, which needs the server only when it is called."""

import secrets
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

from ...core import EpisodeOptions, Points, Policy, Source, source_name
from ...errors import OptionValueError
from ...many.parallel import import_extra
from .game import Game
from .host import Rules


def play(
    simulation: Source,
    policies: Mapping[Any, Policy] | None = None,
    *,
    points: Points = None,
    seats: Iterable[str] = (),
    seed: int | None = None,
    title: str = "",
    limit: float | None = None,
    record: str | PathLike[str] | None = None,
    new: bool = False,
    tools: str = "all",
    time_unit: str = "",
    host: str = "127.0.0.1",
    port: int = 8000,
    **options: Unpack[EpisodeOptions],
) -> str:
    """Serve a page on which people take agents' seats, until an interrupt (Ctrl-C).

    It needs the extra ``play``. The game runs in another process, which imports or unpickles the
    arguments.

    Args:
        simulation: The simulation, as ``simulate`` takes it.
        policies: The policies of agents that no person plays, as ``simulate`` takes them.
        points: The decision points, as ``simulate`` takes them.
        seats: The agents that people play. None: all agents without a policy.
        seed: The seed of the first episode. None: a random one.
        title: The title of the page. "": the name of the simulation.
        limit: The seconds after which the rule decides in place of a person. None: no limit.
        record: A file to which all decisions are appended. If it exists, its game goes on, with the
            same seats and links.
        new: Whether to begin another game in an existing ``record``.
        tools: Who may undo, jump, restart and let the rule play on: "all", "none", or
            "facilitator", who has a link of its own.
        time_unit: The unit of the simulation's time, in the singular, such as "hour".
        host: The address to listen on. Only on one of this machine, all may take free seats.
        port: The port; 0: any free one.
        **options: The options of ``simulate``, and ``max_steps``.

    Returns:
        The returns, as a text.

    Raises:
        SimEnvError: An argument is invalid, or the simulation cannot be played.
    """
    name = source_name(simulation)
    path = None if record is None else Path(record)
    make = partial(
        make_game,
        simulation,
        policies or {},
        points=points,
        name=name,
        seats=list(seats),
        seed=seed,
        record=path,
        new=new,
        options=options,
        rules=Rules(title or name.rpartition(".")[2], tools, limit, time_unit),
    )
    return start(make, host=host, port=port, record=path)


def make_game(
    simulation: Source,
    policies: Mapping[Any, Policy],
    *,
    rules: Rules,
    seed: int | None,
    **arguments: Any,
) -> tuple[Game, Rules]:
    """Make a game, and return it with its rules. The other arguments are those of ``Game``."""
    first = secrets.randbelow(2**31) if seed is None else seed
    return Game(simulation, seed=first, policies=policies, **arguments), rules


def find_game(
    find: Callable[[str], Any],
    simulation: str,
    policies: Iterable[str],
    **arguments: Any,
) -> tuple[Game, Rules]:
    """Make a game of the command line.

    Args:
        find: A function that returns the object of ``module:object``.
        simulation: The simulation, as such a text.
        policies: Policies as ``agent=module:object``, or ``module:object`` for a dict of policies.
        **arguments: The other arguments of ``make_game``.

    Raises:
        OptionValueError: There is no such object, or it is no dict.
    """
    found: dict[Any, Policy] = {}
    for text in policies:
        agent, equals, path = text.partition("=")
        policy = find(path if equals else text)
        if equals:
            found[agent] = policy
        elif isinstance(policy, Mapping):
            found |= policy
        else:
            raise OptionValueError(f"{text} is no dict of policies; write AGENT={text}")
    return make_game(find(simulation), found, **arguments)


def start(make: Any, **options: Any) -> str:
    """Serve a game, as ``serve`` does.

    Raises:
        MissingExtraError: The extra ``play`` is missing.
    """
    for package in ("starlette", "uvicorn", "websockets"):
        import_extra(package, "play")
    from .server import serve

    return serve(make, **options)
