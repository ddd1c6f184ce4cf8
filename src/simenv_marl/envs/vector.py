"""The vector view: many copies of a simulation, stepped together."""

import weakref
from collections.abc import Mapping, Sequence
from itertools import chain
from threading import Lock
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array, iterate
from numpy.typing import NDArray

from ..core import checked_seed, duplicate
from ..errors import (
    ClosedError,
    CopyError,
    EpisodeOverError,
    InvalidActionError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    short_repr,
)
from ..many.parallel import WorkerPool
from ..simulation import RULE
from .base import OneAgentView
from .vector_batch import SimulationBatch


class SimulationVectorEnv(VectorEnv[Any, Any, Any]):
    """Many simulations as one ``gymnasium.vector.VectorEnv``. Made by ``vector_env``.

    It behaves like ``gymnasium.vector.SyncVectorEnv`` with as many single (or joint) views, step by
    step.

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
        simulation: Any,
        points: Any,
        options: Mapping[str, Any],
        view: str | None = None,
        *,
        num_envs: int,
        workers: int = 0,
        copy: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        context: Any = None,
    ) -> None:
        """Make the environment; the arguments are those of ``vector_env``.

        Raises:
            SimEnvError: Something cannot work. The subclass tells what.
        """
        super().__init__()
        self.num_envs = _count(num_envs, "num_envs", 1)
        workers = _count(workers, "workers", 0)
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            raise OptionValueError(
                "autoreset_mode must be one of"
                f" {', '.join(repr(known.value) for known in AutoresetMode)}, not"
                f" {short_repr(autoreset_mode)}"
            ) from None
        self._copy = bool(copy)
        part = range(0 if workers else self.num_envs)
        batch = SimulationBatch(simulation, points, options, view, self._mode, part)
        self.render_mode = batch.plan.options.render_mode
        self.metadata = {**batch.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = batch.observation_space
        self.single_action_space = batch.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        # what is legal is known here
        self._checks_alone = batch.checks_spaces_only
        self._begun = False
        # where the next episode begins with the next step or a reset
        self._ended: frozenset[int] = frozenset()
        self._simulations: SimulationBatch | WorkerPool = batch
        if workers:
            self._simulations = WorkerPool(
                SimulationBatch, batch.arguments, self.num_envs, workers, context
            )
            self._observations = create_empty_array(self.single_observation_space, self.num_envs)
        weakref.finalize(self, self._simulations.abandon)
        self._guard = _Guard()
        self.closed = False

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all simulations, or some of them, and run them to their first decisions.

        Args:
            seed: An integer: the simulations get ``seed``, ``seed + 1``, ... A sequence: each
                simulation gets its own seed (or None). None: each simulation draws a seed from its
                own generator.
            options: Options for the simulations' ``reset``, if it takes them. ``"reset_mask"``, a
                bool array of shape ``(num_envs,)``, selects the simulations to reset.

        Returns:
            The observations of all simulations, and the infos of those that were reset.

        Raises:
            OptionValueError: The seeds or the mask are invalid.
            ClosedError: The environment is closed.
            BaseException: Any exception of a simulation or a mapping, with a note that names the
                simulation. Then all of them need a reset; the ones after it have not been reset.
        """
        with self._guard:
            seeds = self._seeds(seed)
            chosen, options = self._chosen(options)
            answers = self._simulations.ask("reset", seeds, options, chosen)
            self._begun = True
            self._ended -= set(chosen.nonzero()[0].tolist())
            observations, infos = self._joined(answers)
        return duplicate(observations) if self._copy else observations, self._merged(infos)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Answer the pending decision of each simulation and run it to its next one.

        Args:
            actions: A batch of the action space. The actions of simulations that are reset by this
                step are not used.

        Returns:
            Observations, rewards (float64), terminations and truncations (bool), each of shape
            ``(num_envs, ...)``, and infos.

        Raises:
            InvalidActionError: An action is not legal; the message names the simulation. None of
                them has moved.
            ResetNeededError: There is no running episode.
            BaseException: Any exception of a simulation or a mapping, with a note that names the
                simulation. Then all of them need a reset.
        """
        with self._guard:
            if not self._begun:
                raise NotResetError("there is no episode yet; call reset() first")
            if self._simulations.failed:
                raise EpisodeOverError(
                    "an error has ended the episodes; call reset() to begin the next ones"
                )
            if self._ended and self._mode == AutoresetMode.DISABLED:
                raise EpisodeOverError(
                    f"the episodes of the sub-environments {sorted(self._ended)[:10]} are over;"
                    " begin the next ones"
                    ' with reset(options={"reset_mask": ...})'
                )
            answers = self._simulations.ask("step", self._split(actions), self._ended)
            observations, rewards, terminations, truncations, ended, infos = self._joined(answers)
            self._ended = frozenset(ended)
        observations = duplicate(observations) if self._copy else observations
        return observations, rewards, terminations, truncations, self._merged(infos)

    def _joined(self, answers: list[Any]) -> Any:
        """Join what all parts have returned: observations, which the next call overwrites, arrays and lists."""
        if isinstance(self._simulations, SimulationBatch):
            return answers[0]
        observations, *columns = zip(*answers, strict=True)
        self._observations = _join(self.single_observation_space, observations, self._observations)
        lists = [
            np.concatenate(p) if isinstance(p[0], np.ndarray) else [*chain.from_iterable(p)]
            for p in columns
        ]
        return self._observations, *lists

    def _merged(self, infos: list[tuple[int, dict[str, Any]]]) -> dict[str, Any]:
        """Merge infos as Gymnasium does, but key by key, which takes a third of the time."""
        merged: dict[str, Any] = {}
        for key in dict.fromkeys(chain.from_iterable([info for _, info in infos])):
            own = [(number, info[key]) for number, info in infos if key in info]
            number, value = own[0]
            column = self._add_info(merged, {key: value}, number)[key]
            merged[f"_{key}"][[number for number, _ in own]] = True
            if isinstance(column, dict):
                merged[key] = self._merged(own)
                continue
            for number, value in own:
                column[number] = value
        return merged

    def _split(self, actions: Any) -> list[Any]:
        """Split a batch of actions, and check each action that will be used, before any simulation moves."""
        if actions is RULE:
            raise InvalidActionError(
                "RULE is not an action in vector environments; use single_env, or policies="
            )
        space = self.single_action_space
        if type(actions) is np.ndarray and self._checks_alone:
            if not isinstance(space, spaces.Discrete):
                if actions.dtype == space.dtype and self.action_space.contains(actions):
                    return list(actions.copy())  # so that the caller cannot change them
            elif (
                actions.dtype.kind in "iu"
                and actions.shape == (self.num_envs,)
                and actions.min() >= space.start
                and actions.max() < space.start + space.n
            ):
                return actions.tolist()  # type: ignore[no-any-return]
        return list(
            chain.from_iterable(self._simulations.ask("check", self._apart(actions), self._ended))
        )

    def _apart(self, actions: Any) -> list[Any]:
        try:
            apart = list(iterate(self.action_space, actions))
        except Exception as error:
            raise InvalidActionError(
                f"{short_repr(actions)} is not a batch of {self.num_envs} actions of"
                f" {short_repr(self.single_action_space)}"
            ) from error
        if len(apart) != self.num_envs:
            raise InvalidActionError(
                f"there are {len(apart)} actions for {self.num_envs} simulations:"
                f" {short_repr(actions)}"
            )
        return apart

    def _seeds(self, seed: Any) -> list[int | None]:
        if seed is None or isinstance(seed, (int, np.integer)):
            first = checked_seed(seed)
            return [None if first is None else first + number for number in range(self.num_envs)]
        seeds = [checked_seed(part) for part in seed]
        if len(seeds) != self.num_envs:
            raise OptionValueError(f"there are {len(seeds)} seeds for {self.num_envs} simulations")
        return seeds

    def _chosen(
        self, options: dict[str, Any] | None
    ) -> tuple[NDArray[np.bool_], dict[str, Any] | None]:
        """Return which simulations to reset, and the options for them."""
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_), options
        mask = options["reset_mask"]
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
        ):
            raise OptionValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},), not"
                f" {short_repr(mask)}"
            )
        if not mask.any():
            raise OptionValueError("reset_mask selects no simulation to reset")
        if not (self._begun or mask.all()):
            raise NotResetError(
                "there are no episodes yet; call reset() without a reset_mask first"
            )
        if self._simulations.failed and not mask.all():
            raise EpisodeOverError(
                "an error has ended the episodes; call reset() without a reset_mask"
            )
        return mask, {name: value for name, value in options.items() if name != "reset_mask"}

    # -- the simulations --------------------------------------------------------------------------

    @property
    def envs(self) -> list[OneAgentView]:
        """The Gymnasium environments of the simulations, in order."""
        if isinstance(self._simulations, WorkerPool):
            raise AttributeError(
                "the sub-environments are in other processes; use call(), get_attr() and set_attr()"
            )
        return list(self._simulations.views)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each sub-environment, or get its attribute.

        Args:
            name: The name of a method or attribute of a single (or joint) view, such as
                ``simulation``.
            *args: The positional arguments of the method.
            **kwargs: The keyword arguments of the method.

        Returns:
            A tuple of the results.

        Raises:
            ClosedError: The environment is closed.
            BaseException: Any exception of a sub-environment.
        """
        with self._guard:
            return tuple(chain.from_iterable(self._simulations.ask("call", name, args, kwargs)))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each sub-environment, as a tuple."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of each sub-environment.

        Args:
            name: The name of the attribute.
            values: A list or tuple with one value for each sub-environment, or a single value for
                all of them.

        Raises:
            OptionValueError: There are more or fewer values than sub-environments.
        """
        if not isinstance(values, (list, tuple)):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise OptionValueError(
                f"there are {len(values)} values for {self.num_envs} simulations"
            )
        with self._guard:
            self._simulations.ask("set_attr", name, list(values))

    @property  # type: ignore[misc]  # one generator for each cannot be set as one
    def np_random(self) -> Any:
        """The generators of the sub-environments, as a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """The seeds of the sub-environments' generators, as a tuple."""
        return self.get_attr("np_random_seed")

    def render(self) -> tuple[Any, ...]:
        """Render each simulation in ``render_mode``.

        Without a render mode, warn and return a tuple of None.
        """
        return self.call("render")

    def close(self, **kwargs: Any) -> None:
        """Unwind all simulations. The environment cannot be used any more.

        Raises:
            ReentrancyError, WrongThreadError: It cannot be closed from here, and stays open.
            BaseException: The exception of the first simulation that fails to unwind; all others
                are unwound, too.
        """
        if self.closed:
            return
        with self._guard:
            try:
                self._simulations.close()
            finally:
                self.closed = self._guard.closed = self._simulations.idle

    # that of Gymnasium before 1.3 closes and raises; the finalizer warns
    def __del__(self) -> None:
        """Leave the end to the finalizer."""

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled, since the stacks of simulations cannot be."""
        raise CopyError(f"{type(self).__name__} cannot be copied or pickled; make a new one")


class _Guard:
    """The context of a call to a vector environment, in which every other call is refused."""

    __slots__ = ("_lock", "closed")

    def __init__(self) -> None:
        self._lock, self.closed = Lock(), False

    def __enter__(self) -> None:
        if self.closed:
            raise ClosedError("the environment is closed; make a new one")
        if not self._lock.acquire(blocking=False):
            raise ReentrancyError(
                "the environment was used from inside its own simulations or mappings, or while"
                " another thread was stepping, resetting or closing it"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def _count(value: Any, name: str, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise OptionValueError(
            f"{name} must be an integer of at least {least}, not {short_repr(value)}"
        )
    return int(value)


def _join(space: spaces.Space[Any], parts: Sequence[Any], out: Any) -> Any:
    """Join batches of a space into one, which is written into ``out`` where it consists of arrays."""
    if isinstance(space, spaces.Dict):
        return {
            key: _join(inner, [part[key] for part in parts], out[key])
            for key, inner in space.spaces.items()
        }
    if isinstance(space, spaces.Tuple):
        return tuple(
            _join(inner, [part[i] for part in parts], out[i])
            for i, inner in enumerate(space.spaces)
        )
    if isinstance(out, np.ndarray):
        return np.concatenate(parts, out=out)
    return tuple(chain.from_iterable(parts))
