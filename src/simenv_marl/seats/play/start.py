"""The function ``play``, which needs the server only when it is called."""

import secrets
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Final, Unpack

from ...core import EpisodeOptions, Points, Policy, Source, source_name
from ...episodes import EpisodeFile
from ...errors import EpisodeFileError, InvalidActionError, OptionValueError
from ...files.recipes import Json
from ...files.tapes import end_of
from ...many.parallel import import_extra
from ...simulation import RULE, Action
from .forms import jsonable
from .game import Game
from .host import Rules

OF_ONE_LEARNER: Final = ("agent", "flatten", "state_in_info")
"""Options that the environment of a game does not take."""


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
            "facilitator", who has another link.
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


def open_game(path: Path, until: int | None, rules: Rules) -> tuple[Game, Rules]:
    """Make a game that goes on from the file of an episode, of any view.

    Args:
        path: The file.
        until: The number of decisions to repeat, as ``replay_episode`` takes it.
        rules: The rules.

    Raises:
        EpisodeFileError: The file cannot be loaded, or no game can go on from there.
        StoreError: It cannot be read.
    """
    file = EpisodeFile(path, until)
    if file.is_branch:
        raise EpisodeFileError(f"no game can go on from {path}: it is the branch of a planner")
    view = file.load()  # verifies it in its own view
    pending = end_of(view.episode)
    simulation, points, options = file.arguments()
    policies = options.pop("policies", {})
    if view.kind != "aec" or policies:  # it counts other steps than a game does
        limit = options.pop("max_steps", None)
        pending = {} if limit is not None and "end" in pending else pending
    name = view.session.plan.name
    seats = file.head.get("play", {}).get("seats", [])
    if view.kind == "single":
        seats = [view.own_agent.name]
    view.close()
    for option in OF_ONE_LEARNER:
        options.pop(option, None)
    settings: Any = {"points": points, "policies": policies, "options": options}
    game = Game(simulation, name, seats, file.head["seed"], **settings, reset=file.head["reset"])
    try:
        repeat(game, file, pending)
    except InvalidActionError as error:
        game.close()
        raise EpisodeFileError(f"no game can go on from {path}: {error}") from error
    return game, replace(rules, title=rules.title or name)


def repeat(game: Game, file: EpisodeFile, pending: Json) -> None:
    """Take the decisions of a file in a game, where rules take those that the file leaves to them.

    ``pending``: the line of the decision, or of the end, to which they lead. Empty: a limit that
    the game does not have.

    Raises:
        InvalidActionError: They do not lead there.
    """
    decisions: deque[tuple[Json, Action]] = deque()
    deciders = {pending.get("agent")}
    for _, line, answer in file.answers:
        if "reseed" in line:
            raise InvalidActionError("its chance was drawn anew in a clone")
        if "agent" in line:
            decisions.append((line, answer))
            deciders.update(answer if isinstance(line["seen"], dict) else [line["agent"]])
    actions: dict[str, Action] = {}  # of a round, that no decision has used
    while game.now is not None:
        agent = game.now["agent"]
        by = "person" if agent in deciders else "rule"
        if agent in actions:
            answer = actions.pop(agent)
        elif agent in deciders and not decisions:
            break
        elif agent in deciders:
            line, answer = decisions.popleft()
            if agent != line["agent"]:
                raise InvalidActionError(f"{agent} decides in place of {line['agent']}")
            if isinstance(line["seen"], dict):
                actions = {**answer}
                continue
            by = line.get("by", by)
        elif decisions or pending:
            answer = RULE
        else:
            break
        try:
            game.decide(None if answer is RULE else jsonable(answer), by)
        except InvalidActionError:
            if not actions and not isinstance(pending.get("seen"), dict):
                raise
            actions = {}  # it was given before its decision has arisen, and is not legal by now
    decider = None if game.now is None else game.now["agent"]
    if pending and decider != pending.get("agent"):
        raise InvalidActionError(f"{decider} decides in place of {pending.get('agent')}")


def start(make: Any, **options: Any) -> str:
    """Serve a game, as ``serve`` does.

    Raises:
        MissingExtraError: The extra ``play`` is missing.
    """
    for package in ("starlette", "uvicorn", "websockets"):
        import_extra(package, "play")
    from .server import serve

    return serve(make, **options)
