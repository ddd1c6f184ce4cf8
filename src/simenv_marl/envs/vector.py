"""The vector view: many copies of a simulation, stepped together."""

import weakref
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from threading import Lock
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array, iterate
from numpy.typing import NDArray

from ..core.session import checked_seed
from ..core.spaces import duplicate
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
from .vector_batch import SimulationBatch, checked_actions


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
        self.closed = True  # until it is made: older versions of Gymnasium close half-made environments
        self.num_envs = _count(num_envs, "num_envs", 1)
        workers = _count(workers, "workers", 0)
        self._mode = _mode(autoreset_mode)
        self._copy = bool(copy)
        part = range(0 if workers else self.num_envs)
        batch = SimulationBatch(simulation, points, options, view, self._mode, part)
        self.render_mode = batch.plan.options.render_mode
        self.metadata = {**batch.view.metadata_of(batch.plan), "autoreset_mode": self._mode}
        self.single_observation_space = batch.observation_space
        self.single_action_space = batch.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        # The point that takes all actions, if no simulation is needed to check them.
        point = batch.plan.active[0]
        self._point = point if batch.joint is None and point.legal is None else None
        self._agent = str(batch.plan.one_agent)
        self.lock = Lock()
        self._begun = self._failed = False
        self._ended = np.zeros(self.num_envs, np.bool_)  # where the next episode begins with the next step or a reset
        self._simulations: SimulationBatch | WorkerPool = batch
        if workers:
            self._simulations = WorkerPool(SimulationBatch, batch.arguments, self.num_envs, workers, context)
            self._observations = create_empty_array(self.single_observation_space, self.num_envs)
        self._finalizer = weakref.finalize(self, self._simulations.abandon)
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
        with _exclusive(self):
            seeds = self._seeds(seed)
            chosen, options = self._chosen(options)
            answers = self._ask("reset", seeds, options, chosen)
            self._begun, self._failed = True, False
            self._ended = self._ended & ~chosen
            observations, infos = self._joined(answers)
        return duplicate(observations) if self._copy else observations, self._merged(infos)

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
        with _exclusive(self):
            if not self._begun:
                raise NotResetError("there is no episode yet; call reset() first")
            if self._failed:
                raise EpisodeOverError("an error has ended the episodes; call reset() to begin the next ones")
            if self._mode == AutoresetMode.DISABLED and self._ended.any():
                raise EpisodeOverError(
                    f"the episodes of the sub-environments {self._ended.nonzero()[0].tolist()[:10]} are over; begin the"
                    ' next ones with reset(options={"reset_mask": ...})'
                )
            answers = self._ask("step", self._split(actions), self._ended)
            observations, rewards, terminations, truncations, infos = self._joined(answers)
            if self._mode != AutoresetMode.SAME_STEP:
                self._ended = terminations | truncations
        observations = duplicate(observations) if self._copy else observations
        return observations, rewards, terminations, truncations, self._merged(infos)

    def _ask(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of the simulations, here or in workers.

        After an error in a reset or a step they may stand at different steps. Then all of them need a reset.
        """
        simulations = self._simulations
        try:
            return simulations.ask(method, *arguments)
        except BaseException:
            moved = method in ("reset", "step") and not simulations.untouched
            self._failed = self._failed or moved or simulations.broken
            raise

    def _joined(self, answers: list[Any]) -> Any:
        """Join what all parts have returned: observations, which the next call overwrites, arrays and infos."""
        if isinstance(self._simulations, SimulationBatch):
            return answers[0]
        observations, *arrays, infos = zip(*answers, strict=True)
        self._observations = _join(self.single_observation_space, observations, self._observations)
        return self._observations, *map(np.concatenate, arrays), chain.from_iterable(infos)

    def _merged(self, infos: Iterable[tuple[int, dict[str, Any]]]) -> dict[str, Any]:
        """Merge infos as Gymnasium does, but all numbers of a key at once, which takes a fifth of the time."""
        merged: dict[str, Any] = {}
        columns: dict[str, tuple[list[int], list[Any]]] = {}
        for number, info in infos:
            for key, value in info.items():
                numbers, values = columns.setdefault(key, ([], []))
                numbers.append(number)
                values.append(value)
        for key, (numbers, values) in columns.items():
            column = self._add_info(merged, {key: values[0]}, numbers[0])[key]
            merged[f"_{key}"][numbers] = True
            if isinstance(column, dict):
                merged[key] = self._merged(zip(numbers, values, strict=True))
            elif column.dtype != object:
                column[numbers] = values
            else:
                for number, value in zip(numbers, values, strict=True):
                    column[number] = value
        return merged

    def _split(self, actions: Any) -> list[Any]:
        """Split a batch of actions, and check each action that will be used, before any simulation moves."""
        if actions is RULE:
            raise InvalidActionError("RULE is not an action in vector environments; use single_env, or policies=")
        point, space = self._point, self.single_action_space
        if point is None:
            return list(chain.from_iterable(self._ask("check", self._apart(actions), self._ended)))
        if type(actions) is np.ndarray and actions.shape == (self.num_envs, *(space.shape or ())):
            if isinstance(space, spaces.Discrete) and actions.dtype.kind in "iu":
                if actions.min() >= space.start and actions.max() < space.start + space.n:
                    return actions.tolist()  # type: ignore[no-any-return]
            elif (
                isinstance(space, spaces.Box)
                and actions.dtype is space.dtype
                and ((actions >= space.low) & (actions <= space.high)).all()
            ):
                return list(actions.copy())  # so that the caller cannot change them
        check = lambda _, action: point.checked(action, self._agent, None)  # noqa: E731
        return checked_actions(self._apart(actions), self._ended, check)

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
                f"there are {len(apart)} actions for {self.num_envs} simulations: {short_repr(actions)}"
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

    def _chosen(self, options: dict[str, Any] | None) -> tuple[NDArray[np.bool_], dict[str, Any] | None]:
        """Return which simulations to reset, and the options for them."""
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_), options
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise OptionValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},), not {short_repr(mask)}"
            )
        if not mask.any():
            raise OptionValueError("reset_mask selects no simulation to reset")
        if not (self._begun or mask.all()):
            raise NotResetError("there are no episodes yet; call reset() without a reset_mask first")
        if self._failed and not mask.all():
            raise EpisodeOverError("an error has ended the episodes; call reset() without a reset_mask")
        return mask, {name: value for name, value in options.items() if name != "reset_mask"}

    # -- the simulations --------------------------------------------------------------------------

    @property
    def envs(self) -> list[OneAgentView]:
        """The Gymnasium environments of the simulations, in order."""
        if isinstance(self._simulations, WorkerPool):
            raise AttributeError("the sub-environments are in other processes; use call(), get_attr() and set_attr()")
        return list(self._simulations.views)

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
        with _exclusive(self):
            return tuple(chain.from_iterable(self._ask("call", name, args, kwargs)))

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
        with _exclusive(self):
            self._ask("set_attr", name, list(values))

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
        with _exclusive(self):
            try:
                self._simulations.close()
            finally:
                self.closed = self._simulations.idle
                if self.closed:
                    self._finalizer.detach()

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled, since the stacks of simulations cannot be."""
        raise CopyError(f"{type(self).__name__} cannot be copied or pickled; make a new one")


class _exclusive:  # noqa: N801 - it is used like a function
    """A block during which every other call to a vector environment is refused."""

    def __init__(self, env: SimulationVectorEnv) -> None:
        self._env = env

    def __enter__(self) -> None:
        if self._env.closed:
            raise ClosedError("the environment is closed; make a new one")
        if not self._env.lock.acquire(blocking=False):
            raise ReentrancyError(
                "the environment was used from inside its own simulations or mappings, or while another thread was"
                " stepping, resetting or closing it"
            )

    def __exit__(self, *error: object) -> None:
        self._env.lock.release()


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


def _join(space: spaces.Space[Any], parts: Sequence[Any], out: Any) -> Any:
    """Join batches of a space into one, which is written into ``out`` where it consists of arrays."""
    if isinstance(space, spaces.Dict):
        return {key: _join(inner, [part[key] for part in parts], out[key]) for key, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_join(inner, [part[i] for part in parts], out[i]) for i, inner in enumerate(space.spaces))
    if isinstance(out, np.ndarray):
        return np.concatenate(parts, out=out)
    return tuple(chain.from_iterable(parts))
