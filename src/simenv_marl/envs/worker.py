"""A worker process with some of the simulations of a vector environment: its recipe and its main loop.

The user sends one message for all simulations of a worker, and the worker sends one back. Observations, rewards and
flags are in shared memory. Observations that do not form arrays are sent with the message.
"""

from __future__ import annotations

import pickle
import signal
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import create_empty_array, create_shared_memory, read_from_shared_memory

from ..core.packing import pack_error, pack_plainly
from ..core.plan import Plan
from ..decision import decision_points
from .batches import Batch
from .rows import Row, SubEnvironments

EXIT: Final = b""
"""The message that asks a worker to end."""


# -- shared arrays --------------------------------------------------------------------------------


class _Unlocked:
    """An array in shared memory without a lock. It needs no semaphore, which a killed process would leave behind."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def get_obj(self) -> Any:
        """Return the array. Gymnasium calls this method."""
        return self._array


class _UnlockedContext:
    """The part of a ``multiprocessing`` context that makes shared arrays, here without locks."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def Array(self, kind: Any, size: int) -> _Unlocked:  # noqa: N802 - its name in multiprocessing
        return _Unlocked(self._context.RawArray(kind, max(size, 1)))


def is_shareable(space: spaces.Space[Any]) -> bool:
    """Whether batches of a space consist only of arrays of a fixed size."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return all(map(is_shareable, parts))
    return isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))


def _record_space(space: spaces.Space[Any]) -> spaces.Dict:
    """Make the space of the results of one step of a simulation."""
    flag: Any = spaces.Box(0, 1, (), np.bool_)
    told: dict[str, Any] = {
        "rewards": spaces.Box(-np.inf, np.inf, (), np.float64), "terminations": flag, "truncations": flag,
    }  # fmt: skip
    return spaces.Dict(told | {"observations": space} if is_shareable(space) else told)


def share_memory(space: spaces.Space[Any], number: int, context: Any) -> Any:
    """Make shared memory for the results of one step of many simulations.

    Args:
        space: The observation space of one simulation.
        number: The number of simulations.
        context: The ``multiprocessing`` context whose processes share the memory.
    """
    return create_shared_memory(_record_space(space), number, _UnlockedContext(context))  # type: ignore[arg-type]


def shared_batch(space: spaces.Space[Any], number: int, memory: Any, share: slice | None = None) -> Batch:
    """Make a batch whose arrays lie in shared memory.

    Args:
        space: The observation space of one simulation.
        number: The number of simulations.
        memory: The memory that ``share_memory`` returned.
        share: The simulations of the batch. None: all.
    """
    told: Any = read_from_shared_memory(_record_space(space), memory, number)
    share = slice(0, number) if share is None else share
    size = share.stop - share.start
    observations = told.get("observations")
    batch = Batch(create_empty_array(space, size) if observations is None else _part(observations, share), size)
    batch.rewards, batch.terminations = told["rewards"][share], told["terminations"][share]
    batch.truncations = told["truncations"][share]
    return batch


def _part(batch: Any, share: slice) -> Any:
    """A part of the rows of batched observations, as array views."""
    if isinstance(batch, dict):
        return {key: _part(value, share) for key, value in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_part(value, share) for value in batch)
    return batch[share]


# -- the recipe of a worker -----------------------------------------------------------------------


@dataclass(frozen=True)
class Recipe:
    """The arguments of ``vector_env`` from which a worker makes its simulations."""

    simulation: Any
    points: Any
    options: Mapping[str, Any]
    view: str | None

    def plan(self) -> Plan:
        """Draw up a plan from the arguments."""
        return Plan.draw_up(self.simulation, self.points, self.options)

    def spelt_out(self, common: SubEnvironments) -> Recipe:
        """Add to the arguments what only this process can find out: the registered points and the agents."""
        points, options = self.points, self.options
        named = [named.point for named in common.plan._named]
        if points is None and [point.name for point in named] == decision_points():
            points = decision_points()
        if not common.single:
            options = {**options, "possible_agents": common.plan.options.possible_agents}
        return Recipe(self.simulation, points, options, "single" if common.single else "joint")


# -- the process ----------------------------------------------------------------------------------


def work(
    pipe: Connection,
    others: Iterable[Connection],
    recipe: Any,
    memory: Any,
    *,
    number: int,
    first: int,
    end: int,
    mode: AutoresetMode,
) -> None:
    """The main function of a worker.

    Args:
        pipe: The pipe to the user.
        others: Ends of pipes that the worker has inherited and that belong to other processes.
        recipe: A pickled recipe.
        memory: The memory that the worker and the user share.
        number: The number of simulations of all workers.
        first: The number of the worker's first simulation.
        end: The number after that of the worker's last simulation.
        mode: When a new episode follows one that has ended.
    """
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the user's process, which decides what to do
    for other in others:
        other.close()
    row: Row | None = None
    try:
        try:
            made: Recipe = pickle.loads(recipe)
            common = SubEnvironments(made.plan(), made.view)
            space = common.single_observation_space
            batch = shared_batch(space, number, memory, slice(first, end))
            row = Row(common, batch, mode, end - first, first)
        except BaseException as error:
            _send(pipe, 0, error=error)
            return
        _send(pipe, 0)
        while (message := pipe.recv_bytes()) != EXIT:
            _serve(pipe, row, message, sends_rows=not is_shareable(space))
    except (EOFError, OSError):  # the user's process has ended
        pass
    finally:
        if row is not None:
            row.abandon()


def _serve(pipe: Connection, row: Row, message: bytes, *, sends_rows: bool) -> None:
    identity = 0
    try:
        identity, method, arguments = pickle.loads(message)
        result = getattr(row, method)(*arguments)
        if method in ("reset", "step"):
            result = result, row.observed if sends_rows else None
        answer = pack_plainly((identity, True, result))
    except BaseException as error:
        _send(pipe, identity, error=error)
        return
    pipe.send_bytes(answer)


def _send(pipe: Connection, identity: int, *, error: BaseException | None = None) -> None:
    pipe.send_bytes(pickle.dumps((identity, error is None, None if error is None else pack_error(error)), 5))
