"""The vector view: many copies of a simulation, stepped together."""

import weakref
from collections.abc import Iterable, Sequence
from threading import Lock
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import NDArray

from ..core.session import checked_seed
from ..core.spaces import duplicate
from ..errors import (
    ClosedError,
    CopyError,
    EpisodeOverError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    short_repr,
)
from .batches import Actions, Batch
from .one_agent import OneAgentView
from .rows import Row, SubEnvironments
from .worker import Recipe
from .workers import Workers


class SimulationVectorEnv(VectorEnv[Any, Any, Any]):
    """Many simulations as one ``gymnasium.vector.VectorEnv``. Made by ``vector_env``.

    It behaves like ``gymnasium.vector.SyncVectorEnv`` with as many single (or joint) views, step by step.

    Attributes:
        num_envs: The number of simulations.
        single_observation_space, single_action_space: The spaces of one simulation.
        observation_space, action_space: The batched spaces of all simulations.
        metadata: The metadata of the view, with ``autoreset_mode``.
        render_mode: The render mode of each simulation.
        closed: Whether it was closed.
    """

    def __init__(
        self,
        recipe: Recipe,
        *,
        num_envs: int,
        workers: int = 0,
        copy: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        context: Any = None,
    ) -> None:
        """Make the environment of a recipe; the other arguments are those of ``vector_env``.

        Raises:
            SimEnvError: Something cannot work. The subclass tells what.
        """
        super().__init__()
        self.closed = True  # until it is made: older versions of Gymnasium close half-made environments
        self.num_envs = _count(num_envs, "num_envs", 1)
        workers = _count(workers, "workers", 0)
        self._mode = _mode(autoreset_mode)
        self._copy = bool(copy)
        plan = recipe.plan()
        common = SubEnvironments(plan, recipe.view)
        self.render_mode = plan.options.render_mode
        self.metadata = {**common.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = common.single_observation_space
        self.single_action_space = common.single_action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        point = common.plan.active[0] if common.single else None
        self._actions = Actions(self.single_action_space, self.num_envs, point)
        self._begun = False
        self._moving = Lock()
        self._crew: Row | Workers
        if workers:
            self._crew = Workers(recipe, common, self._mode, self.num_envs, workers, context)
        else:
            batch = Batch(create_empty_array(self.single_observation_space, self.num_envs), self.num_envs)
            self._crew = Row(common, batch, self._mode, self.num_envs)
        self._batch = self._crew.batch
        self._finalizer = weakref.finalize(self, self._crew.abandon)
        self.closed = False

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all simulations, or some of them, and run them to their first decisions.

        Args:
            seed: An integer: the simulations get ``seed``, ``seed + 1``, ... A sequence: each simulation gets its own
                seed (or None). None: each simulation draws a seed from its own generator.
            options: Options for the simulations' ``reset``, if it takes them. ``"reset_mask"``, a bool array of shape
                ``(num_envs,)``, selects the simulations to reset.

        Returns:
            The observations of all simulations, and the infos of those that were reset.

        Raises:
            OptionValueError: The seeds or the mask are invalid.
            ClosedError: The environment is closed.
            BaseException: Any exception of a simulation or a mapping, with a note that names the simulation. Then all
                of them need a reset; the ones after it have not been reset.
        """
        self._enter()
        try:
            seeds = self._seeds(seed)
            chosen, options = self._chosen(options)
            told = self._crew.reset(seeds, options, chosen)
            self._begun = True
        finally:
            self._moving.release()
        observations = self._batch.observations
        return duplicate(observations) if self._copy else observations, _merged(told, self.num_envs)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Answer the pending decision of each simulation and run it to its next one.

        Args:
            actions: A batch of the action space. The actions of simulations that are reset by this step are not used.

        Returns:
            Observations, rewards (float64), terminations and truncations (bool), each of shape ``(num_envs, ...)``, and
            infos.

        Raises:
            InvalidActionError: An action is not legal; the message names the simulation. None of them has moved.
            ResetNeededError: There is no running episode.
            BaseException: Any exception of a simulation or a mapping, with a note that names the simulation. Then all
                of them need a reset.
        """
        self._enter()
        try:
            crew = self._crew
            if not self._begun:
                raise NotResetError("there is no episode yet; call reset() first")
            if crew.failed:
                raise EpisodeOverError("an error has ended the episodes; call reset() to begin the next ones")
            ended = crew.ended
            if ended and self._mode == AutoresetMode.DISABLED:
                raise EpisodeOverError(
                    f"the episodes of the sub-environments {sorted(ended)[:10]} are over; begin the next ones with"
                    ' reset(options={"reset_mask": ...})'
                )
            parts = self._actions.split(actions, ended)
            if not self._actions.complete:
                crew.check(parts)
            told = crew.step(parts)
        finally:
            self._moving.release()
        batch = self._batch
        observations = batch.observations
        return (
            duplicate(observations) if self._copy else observations,
            batch.rewards.copy(),
            batch.terminations.copy(),
            batch.truncations.copy(),
            _merged(told, self.num_envs),
        )

    def _enter(self) -> None:
        if self.closed:
            raise ClosedError("the environment is closed; make a new one")
        if not self._moving.acquire(blocking=False):
            raise ReentrancyError(
                "the environment was used from inside its own simulations or mappings, or while another thread was"
                " stepping, resetting or closing it"
            )

    def _seeds(self, seed: Any) -> list[int | None]:
        if seed is None or isinstance(seed, (int, np.integer)):
            first = checked_seed(seed)
            return [None if first is None else first + number for number in range(self.num_envs)]
        seeds = [checked_seed(part) for part in seed]
        if len(seeds) != self.num_envs:
            raise OptionValueError(f"there are {len(seeds)} seeds for {self.num_envs} simulations")
        return seeds

    def _chosen(self, options: dict[str, Any] | None) -> tuple[list[int], dict[str, Any] | None]:
        """Return the simulations to reset, and the options for them."""
        numbers = list(range(self.num_envs))
        if options is None or "reset_mask" not in options:
            return numbers, options
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise OptionValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},), not {short_repr(mask)}"
            )
        chosen: list[int] = np.flatnonzero(mask).tolist()
        if not chosen:
            raise OptionValueError("reset_mask selects no simulation to reset")
        if chosen != numbers and not self._begun:
            raise NotResetError("there are no episodes yet; call reset() without a reset_mask first")
        if chosen != numbers and self._crew.failed:
            raise EpisodeOverError("an error has ended the episodes; call reset() without a reset_mask")
        return chosen, {name: value for name, value in options.items() if name != "reset_mask"}

    # -- the simulations --------------------------------------------------------------------------

    @property
    def envs(self) -> list[OneAgentView]:
        """The Gymnasium environments of the simulations, in order."""
        return list(self._crew.views)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each sub-environment, or get its attribute.

        Args:
            name: The name of a method or attribute of a single (or joint) view, such as ``simulation``.
            *args: The positional arguments of the method.
            **kwargs: The keyword arguments of the method.

        Returns:
            A tuple of the results.

        Raises:
            ClosedError: The environment is closed.
            BaseException: Any exception of a sub-environment.
        """
        self._enter()
        try:
            return tuple(self._crew.call(name, args, kwargs))
        finally:
            self._moving.release()

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each sub-environment, as a tuple."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of each sub-environment.

        Args:
            name: The name of the attribute.
            values: A list or tuple with one value for each sub-environment, or a single value for all of them.

        Raises:
            OptionValueError: There are more or fewer values than sub-environments.
        """
        if not isinstance(values, (list, tuple)):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise OptionValueError(f"there are {len(values)} values for {self.num_envs} simulations")
        self._enter()
        try:
            self._crew.set_attr(name, values)
        finally:
            self._moving.release()

    @property  # type: ignore[misc]  # one generator for each cannot be set as one
    def np_random(self) -> Any:
        """The generators of the sub-environments, as a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """The seeds of the sub-environments' generators, as a tuple."""
        return self.get_attr("np_random_seed")

    def render(self) -> tuple[Any, ...]:
        """Render each simulation in ``render_mode``. Without a render mode, warn and return a tuple of None."""
        return self.call("render")

    def close(self, **kwargs: Any) -> None:
        """Unwind all simulations. The environment cannot be used any more.

        Raises:
            ReentrancyError, WrongThreadError: It cannot be closed from here, and stays open.
            BaseException: The exception of the first simulation that fails to unwind; all others are unwound, too.
        """
        if self.closed:
            return
        self._enter()
        try:
            self._crew.close()
        finally:
            self._moving.release()
            self.closed = not self._crew.suspended
            if self.closed:
                self._finalizer.detach()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled, since the stacks of simulations cannot be."""
        raise CopyError(f"{type(self).__name__} cannot be copied or pickled; make a new one")


def _merged(told: Iterable[tuple[int, Any]], number: int) -> dict[str, Any]:
    """Merge the infos of many simulations, as ``VectorEnv._add_info`` does one by one, but key by key."""
    columns: dict[str, tuple[list[int], list[Any]]] = {}
    for index, info in told:
        for key, value in info.items():
            column = columns.get(key)
            if column is None:
                column = columns[key] = [], []
            column[0].append(index)
            column[1].append(value)
    infos: dict[str, Any] = {}
    for key, (indices, values) in columns.items():
        infos[f"_{key}"] = mask = np.zeros(number, np.bool_)
        mask[indices] = True
        infos[key] = _column(key, indices, values, number)
    return infos


def _column(key: str, indices: list[int], values: list[Any], number: int) -> Any:
    first = values[0]
    column: NDArray[Any]
    if isinstance(first, dict) and key != "final_obs":
        return _merged(zip(indices, values, strict=True), number)
    if key != "final_obs" and (type(first) in (int, float, bool) or isinstance(first, np.number)):
        column = np.zeros(number, type(first))
        column[indices] = values
    elif key != "final_obs" and isinstance(first, np.ndarray):
        column = np.zeros((number, *first.shape), first.dtype)
        column[indices] = values
    else:
        column = np.full(number, None, object)
        for index, value in zip(indices, values, strict=True):
            column[index] = value
    return column


def _count(value: Any, name: str, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise OptionValueError(f"{name} must be an integer of at least {least}, not {short_repr(value)}")
    return int(value)


def _mode(mode: Any) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise OptionValueError(
            f"autoreset_mode must be one of {', '.join(repr(known.value) for known in AutoresetMode)}, not"
            f" {short_repr(mode)}"
        ) from None
