"""The vector view: many copies of a simulation, stepped together."""

import weakref
from collections.abc import Mapping, Sequence, Sized
from copy import deepcopy
from functools import partial
from itertools import chain
from multiprocessing.context import BaseContext
from threading import Lock
from typing import Any, Final, NoReturn

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array, iterate
from numpy.typing import NDArray

from ..core import (
    Action,
    Info,
    Model,
    Observation,
    Points,
    checked_seed,
    duplicate,
    stacker,
)
from ..decision import decision_points
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
from ..many.restarts import RestartingPool
from ..simulation import RULE, check_count
from .agents import OneAgentView
from .base import ResetOptions
from .joint import SimulationJointEnv
from .single import SimulationEnv, plan_of
from .turn import SimulationTurnEnv
from .vector_batch import Infos, SimulationBatch, make_batch

VIEWS: Final[Mapping[str, type[OneAgentView]]] = {
    "single": SimulationEnv,
    "joint": SimulationJointEnv,
    "turn": SimulationTurnEnv,
}
"""The views that can be stepped together."""


class _Guard:
    """Refuses all other calls during a call, and all calls after the end."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._is_closed = False

    def close(self) -> None:
        """Refuse all calls from now on."""
        self._is_closed = True

    def __enter__(self) -> None:
        if self._is_closed:
            raise ClosedError("the environment is closed; make a new one")
        if not self._lock.acquire(blocking=False):
            raise ReentrancyError(
                "the environment was used from inside its own simulations or mappings, or while"
                " another thread was stepping, resetting or closing it"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class SimulationVectorEnv(VectorEnv[Observation, Action, Any]):
    """Many simulations as one ``gymnasium.vector.VectorEnv``. ``vector_env`` makes it.

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
        simulation: Model,
        points: Points,
        options: Mapping[str, Any],
        view: str | None,
        *,
        num_envs: int,
        workers: int,
        copy: bool,
        autoreset_mode: AutoresetMode | str,
        context: BaseContext | str | None,
        restart: bool,
        most_restarts: int,
    ) -> None:
        """Make the environment. ``vector_env`` explains the arguments.

        Raises:
            SimEnvError: An argument is invalid. The message says which.
        """
        super().__init__()
        self.num_envs = check_count(num_envs, "num_envs", 1)
        workers = check_count(workers, "workers")
        check_count(most_restarts, "most_restarts")
        if restart and not workers:
            raise OptionValueError("restart=True restarts workers, and needs workers=")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise OptionValueError(
                f"autoreset_mode must be one of {modes}, not {short_repr(autoreset_mode)}"
            ) from None
        self._copy = copy
        plan = plan_of(simulation, points, options)
        if view is None:
            view = "joint" if plan.one_agent is None else "single"
        kind = VIEWS.get(view)
        if kind is None:
            raise OptionValueError(
                f'view must be None, "single", "joint" or "turn", not {short_repr(view)}'
            )
        if kind.in_rounds and not plan.complete:
            first = kind(plan)  # finds all agents
            first.close()
            plan = first.session.plan
            options = {**options, "possible_agents": plan.options.possible_agents}
        self.render_mode = plan.options.render_mode
        self.metadata = {**kind.metadata_of(plan), "autoreset_mode": self._mode}
        single_spaces = deepcopy(kind.spaces_of(kind.adapt(plan)))
        self.single_observation_space, self.single_action_space = single_spaces
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        # Whether each action of the action space is legal, at any time.
        self._checks_spaces_only = kind is SimulationEnv and plan.active[0].legal is None
        self._begun = False
        # Whether the next episode of each simulation begins with the next step or reset.
        self._ended = np.zeros(self.num_envs, np.bool_)
        settings = kind, self.single_observation_space, self._mode
        self._simulations: SimulationBatch | WorkerPool
        if workers:
            names = [point.name for point in plan.subject.named]
            if points is None and names == decision_points():  # others may be there
                points = names
            arguments = simulation, points, options, *settings
            kind_of_pool = partial(RestartingPool, most_restarts) if restart else WorkerPool
            self._simulations = kind_of_pool(make_batch, arguments, self.num_envs, workers, context)
            self._stack = stacker(self.single_observation_space, cast=True)
            self._stacked = create_empty_array(self.single_observation_space, self.num_envs)
        else:
            self._simulations = SimulationBatch(plan, *settings, range(self.num_envs))
        weakref.finalize(self, self._simulations.abandon)
        self._guard = _Guard()
        self.closed = False

    # -- episodes ---------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: ResetOptions = None,
    ) -> tuple[Observation, Info]:
        """Reset all simulations, or some of them, and run them to their first decisions.

        Args:
            seed: An integer: the simulations get ``seed``, ``seed + 1``, ... A sequence: each
                simulation gets its own seed (or None). None: each simulation draws a seed from its
                own generator.
            options: Options for the simulations' ``reset``, if it takes them. ``"reset_mask"``, a
                bool array of shape ``(num_envs,)``, selects the simulations to reset.

        Returns:
            The observations of all simulations, and the infos of the ones that were reset.

        Raises:
            OptionValueError: The seeds or the mask are invalid.
            ClosedError: The environment is closed.
            BaseException: Any exception of a simulation or a mapping, with a note that names the
                simulation. Then all of them need a reset; the ones after it have not been reset.
        """
        with self._guard:
            seeds = self._seeds(seed)
            chosen, options = self._chosen(options)
            results = self._simulations.ask("reset", seeds, options, chosen)
            self._begun = True
            self._ended[chosen] = False
            observations, infos = self._join(results)
        return observations, self._merge(infos)

    def step(
        self, actions: Action
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
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
            self._check_begun()
            if self._mode == AutoresetMode.DISABLED and self._ended.any():
                numbers = self._ended.nonzero()[0][:10].tolist()
                raise EpisodeOverError(
                    f"the episodes of the sub-environments {numbers} are over;"
                    " begin the next ones"
                    ' with reset(options={"reset_mask": ...})'
                )
            ended = self._ended.tolist()
            results = self._simulations.ask("step", self._split(actions), ended)
            observations, rewards, terminations, truncations, infos = self._join(results)
            if self._mode != AutoresetMode.SAME_STEP:
                self._ended = terminations | truncations
        return (
            observations,
            rewards,
            terminations,
            truncations,
            self._merge(infos),
        )

    def _check_begun(self) -> None:
        """Check that all simulations have begun, and that no error has ended them."""
        if not self._begun:
            raise NotResetError("there is no episode yet; call reset() first, without a reset_mask")
        if self._simulations.failed:
            raise EpisodeOverError(
                "an error has ended the episodes; call reset() without a reset_mask to begin the"
                " next ones"
            )

    def _join(self, results: list[Any]) -> tuple[Any, ...]:
        """Join the results of all parts: observations, arrays and lists."""
        observations, *columns = results[0]
        if isinstance(self._simulations, WorkerPool):
            parts, *others = zip(*results, strict=True)
            items = [iterate(self.observation_space, part) for part in parts]
            observations = self._stack(list(chain.from_iterable(items)), self._stacked)
            columns = [
                np.concatenate(column)
                if isinstance(column[0], np.ndarray)
                else list(chain.from_iterable(column))
                for column in others
            ]
        return duplicate(observations) if self._copy else observations, *columns

    def _merge(self, infos: Infos) -> Info:
        """Merge the infos of sub-environments, as Gymnasium does. Known keys take less time."""
        merged: Info = {}
        for number, info in infos:
            for key, value in info.items():
                if key in merged and not isinstance(value, dict):
                    merged[key][number] = value
                    merged[f"_{key}"][number] = True
                else:
                    merged = self._add_info(merged, {key: value}, number)
        return merged

    def _split(self, actions: Action) -> list[Action]:
        """Split a batch of actions. Check all that will be used, before any simulation moves."""
        if actions is RULE:
            raise InvalidActionError(
                "RULE is not an action in vector environments; use single_env, or policies="
            )
        space = self.single_action_space
        if type(actions) is np.ndarray and self._checks_spaces_only:
            if not isinstance(space, spaces.Discrete):
                if actions.dtype == space.dtype and self.action_space.contains(actions):
                    return list(actions.copy())  # so that the caller cannot change them
            elif (
                actions.dtype.kind in "iu"
                and actions.shape == (self.num_envs,)
                and actions.min() >= space.start
                and actions.max() < space.start + space.n
            ):
                return list(actions.tolist())
        try:
            parts = list(iterate(self.action_space, actions))
        except Exception as error:
            raise InvalidActionError(
                f"{short_repr(actions)} is not a batch of {self.num_envs} actions of"
                f" {short_repr(space)}"
            ) from error
        if len(parts) != self.num_envs:
            raise InvalidActionError(
                f"there are {len(parts)} actions for {self.num_envs} simulations:"
                f" {short_repr(actions)}"
            )
        return list(
            chain.from_iterable(self._simulations.ask("check", parts, self._ended.tolist()))
        )

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            seed = [seed, *range(seed + 1, seed + self.num_envs)]
        self._check_number(seed, "seeds")
        return [checked_seed(part) for part in seed]

    def _check_number(self, items: Sized, noun: str) -> None:
        if len(items) != self.num_envs:
            raise OptionValueError(f"there are {len(items)} {noun} for {self.num_envs} simulations")

    def _chosen(self, options: ResetOptions) -> tuple[NDArray[np.bool_], ResetOptions]:
        """Return the mask of the simulations to reset, and the options for them."""
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_), options
        others = dict(options)
        mask = others.pop("reset_mask")
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_
        if not is_mask or mask.shape != (self.num_envs,):
            raise OptionValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},), not"
                f" {short_repr(mask)}"
            )
        if not mask.any():
            raise OptionValueError("reset_mask selects no simulation to reset")
        if not mask.all():
            self._check_begun()
        return mask, others

    # -- the simulations --------------------------------------------------------------------------

    @property
    def restarts(self) -> int:
        """The number of workers that were lost and replaced, with ``restart=True``."""
        return self._simulations.restarts

    @property
    def envs(self) -> list[OneAgentView]:
        """The Gymnasium environments of the simulations, in order."""
        if isinstance(self._simulations, WorkerPool):
            raise AttributeError(
                "the sub-environments are in other processes; use call(), get_attr() and set_attr()"
            )
        return list(self._simulations.views)

    def call(
        self,
        name: str,
        *args: Model,
        **kwargs: Model,
    ) -> tuple[Model, ...]:
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

    def get_attr(self, name: str) -> tuple[Model, ...]:
        """Return an attribute of each sub-environment, as a tuple."""
        return self.call(name)

    def set_attr(self, name: str, values: Model) -> None:
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
        self._check_number(values, "values")
        with self._guard:
            self._simulations.ask("set_attr", name, list(values))

    @property  # type: ignore[misc]  # it cannot be set, because each has its own
    def np_random(self) -> Any:
        """The generators of the sub-environments, as a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """The seeds of the sub-environments' generators, as a tuple."""
        return self.get_attr("np_random_seed")

    def render(self) -> tuple[Model, ...]:
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
                self.closed = self._simulations.idle
                if self.closed:
                    self._guard.close()

    def __del__(self) -> None:
        """Leave the end to the finalizer, which warns. Gymnasium before 1.3 raises here."""

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        """Refuse to be copied or pickled, since the stacks of simulations cannot be."""
        raise CopyError(f"{type(self).__name__} cannot be copied or pickled; make a new one")
