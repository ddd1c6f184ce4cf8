"""Demonstrations: what the model's own rule, or whoever decides, has done, for learners that imitate it.

Everything here is ``collect_episodes`` and what is made of its ``Trajectories``. Minari is only imported where a data
set is written.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..core.bindings import Binding
from ..core.provenance import provenance
from ..core.stacking import joined, rows, stacker, taken
from ..errors import DefinitionError, InvalidActionError, MissingExtraError, OptionValueError
from ..simulation import RULE
from .batch import Asked
from .collect import collect_episodes, learners_plan
from .trajectories import Trajectories, answers

__all__ = ["Comparison", "Mixture", "compare_with_rule", "record_dataset", "save_dataset"]


PLAYING: Final = ("batch_size", "collect", "progress", "workers")
"""Options of ``collect_episodes`` that are none of the environment."""


# -- who demonstrates -----------------------------------------------------------------------------


class Mixture:
    """A policy of many that leaves each decision to one of several, which is drawn for it.

    What is drawn depends on the seed of the episode and the number of the decision in it, and on nothing else: not on
    what else runs beside it, in however many processes. Which one has decided stands in ``extras["component"]``; what
    they have returned beside their actions is dropped.

    Example:
        ``Mixture({RULE: 0.8, trained: 0.2})``
    """

    def __init__(self, parts: Mapping[Any, float] | Iterable[tuple[Any, float]]) -> None:
        """Mix policies.

        Args:
            parts: A dict from policy to weight, or pairs of these. A policy is what ``collect_episodes`` takes; a
                weight is not negative, and they need not sum to one.

        Raises:
            OptionValueError: There are no policies, or their weights are none.
        """
        pairs = list(parts.items() if isinstance(parts, Mapping) else parts)
        if not pairs or any(not isinstance(pair, tuple) or len(pair) != 2 for pair in pairs):
            raise OptionValueError(f"a mixture is a dict from policies to weights, or pairs of these, not {parts!r}")
        for policy, weight in pairs:
            if policy is not RULE and not callable(policy):
                raise OptionValueError(f"a mixture is one of policies, callables or RULE, not of {policy!r}")
            if (
                isinstance(weight, bool)
                or not isinstance(weight, (int, float))
                or not (isfinite(weight) and weight >= 0)
            ):
                raise OptionValueError(
                    f"the weight of {policy!r} must be a number that is not negative, not {weight!r}"
                )
        weights = np.array([weight for _, weight in pairs], np.float64)
        if not weights.sum() > 0:
            raise OptionValueError("some weight of a mixture must be positive")
        self.policies: tuple[Any, ...] = tuple(policy for policy, _ in pairs)
        self.weights: NDArray[np.float64] = weights / weights.sum()
        self._bounds = np.cumsum(self.weights)[:-1]
        self._asked = [None if policy is RULE else Asked(policy) for policy in self.policies]

    def __repr__(self) -> str:
        parts = zip(self.policies, self.weights.tolist(), strict=True)
        return f"<Mixture: {', '.join(f'{weight:.3g} {_name(policy)}' for policy, weight in parts)}>"

    def __call__(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        """Answer decisions, as policies of ``collect_episodes`` do."""
        component = np.searchsorted(self._bounds, _drawn(identities), side="right")
        actions: list[Any] = [RULE] * len(identities)
        for number, asked in enumerate(self._asked):
            own = np.flatnonzero(component == number)
            if asked is None or not len(own):
                continue
            where = own.tolist()
            returned = asked.answers(
                taken(observations, own), [infos[row] for row in where], [identities[row] for row in where]
            )
            for row, action in zip(where, _rows(returned, len(where), self.policies[number]), strict=True):
                actions[row] = action
        return actions, {"component": component}


def _drawn(identities: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """A number in [0, 1) for each decision, that depends on its identity alone."""
    # SplitMix64, twice: a generator of its own for each decision would take longer than the decision.
    state = np.array([seed % 2**64 for seed, _ in identities], np.uint64)
    turns = np.array([turn for _, turn in identities], np.uint64)
    return np.asarray((_mixed(_mixed(state) + turns) >> np.uint64(11)) * 2.0**-53, np.float64)


def _mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def _rows(returned: Any, number: int, policy: Any) -> list[Any]:
    """What a policy has decided of so many decisions, without its extras."""
    if type(returned) is tuple and len(returned) == 2 and isinstance(returned[1], Mapping):
        returned = returned[0]
    actions = [RULE] * number if returned is RULE else rows(returned, integers=False)
    if actions is None or len(actions) != number:
        what = repr(returned) if actions is None else f"{len(actions)} actions"
        raise InvalidActionError(f"{policy!r} was asked for {number} decisions at once and has returned {what}")
    return actions


# -- data sets ------------------------------------------------------------------------------------


def record_dataset(
    dataset_id: str | Mapping[Any, str],
    simulation: Any,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Any = None,
    metadata: Mapping[str, Any] | None = None,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Any,
) -> Any:
    """Play one episode per seed, and write what was decided as a Minari data set, for offline learners.

    A data set is of one policy, and an episode in it is what one agent has lived through: that of an agent alone in the
    single view, or of each of many that share the policy. See ``save_dataset`` for what is in it.

    Args:
        dataset_id: What the data set is called, such as ``"greenhouse/rule-v0"``; where there are several policies, a
            dict from their keys to such names. Those without a name take part, and are not recorded.
        simulation: As ``collect_episodes`` takes it.
        policies: Who decides: ``RULE``, a callable, or a ``Mixture``, as ``collect_episodes`` takes them. What the rule
            decides is known as an action where its point has a ``rule_action_mapping``, or none is needed.
        seeds: What the simulations are reset with, non-negative integers.
        points: The decision points, as ``generate_env`` takes them.
        metadata: What Minari is told besides: see ``save_dataset``. Without an ``algorithm_name``, that is the name of
            the policy. What ``provenance`` says is always told.
        batch_size: How many simulations may be suspended together: see ``collect_episodes``, as for the next two.
        workers: How many processes share the work.
        progress: Whether to show a bar.
        **options: As ``aec_env`` takes them.

    Returns:
        The ``minari.MinariDataset``; where ``dataset_id`` is a dict, a dict of these.

    Raises:
        OptionValueError: There is such a data set already, or an argument cannot have its value.
        DefinitionError: It is not known which actions the rule's decisions are.
        MissingExtraError: Minari is missing.
        SimEnvError: As ``collect_episodes`` does; so are all other errors.
    """
    if not isinstance(policies, Mapping) or not policies:
        raise OptionValueError(f"policies must be a dict from agents or points to policies, not {policies!r}")
    names = _dataset_ids(dataset_id, policies)
    _check_free(names.values())
    _check_knowable(simulation, policies, names, points, options)
    sizes: dict[str, Any] = {"batch_size": batch_size, "workers": workers, "progress": progress}
    collected = collect_episodes(simulation, policies, seeds=seeds, points=points, **sizes, **options)
    for key, name in names.items():
        _check_writable(name, collected[key])
    origin = provenance(simulation, points, **options)
    written = {}
    for key, name in names.items():
        given = {"algorithm_name": _name(policies[key]), **(metadata or {})}
        written[key] = save_dataset(name, collected[key], **given)
        written[key].storage.update_metadata({"provenance": origin})
    return written if isinstance(dataset_id, Mapping) else next(iter(written.values()))


def _name(policy: Any) -> str:
    return "rule" if policy is RULE else str(getattr(policy, "__qualname__", None) or repr(policy))


def _dataset_ids(dataset_id: Any, policies: Mapping[Any, Any]) -> dict[Any, str]:
    if isinstance(dataset_id, str):
        if len(policies) > 1:
            raise OptionValueError(
                f"{len(policies)} policies need a data set each: give a dict from their keys to names, not"
                f" {dataset_id!r}"
            )
        return {next(iter(policies)): dataset_id}
    if (
        not isinstance(dataset_id, Mapping)
        or not dataset_id
        or not all(isinstance(n, str) for n in dataset_id.values())
    ):
        raise OptionValueError(f"dataset_id must be a name, or a dict of names, not {dataset_id!r}")
    unknown = [key for key in dataset_id if key not in policies]
    if unknown:
        raise OptionValueError(f"dataset_id names {unknown[0]!r}, for whom there is no policy")
    if len(set(dataset_id.values())) < len(dataset_id):
        raise OptionValueError(f"each policy needs a data set of its own: {dict(dataset_id)!r}")
    return dict(dataset_id)


def save_dataset(dataset_id: str, trajectories: Trajectories, **metadata: Any) -> Any:
    """Write what one policy has decided as a Minari data set.

    Each trajectory becomes an episode, with its seed. Its observations are one more than its actions, the last one is
    what the agent came to; terminations and truncations are Gymnasium's. Its infos, as many as observations, are
    ``by_rule``, ``action_mask`` and ``time`` where there are such, and all extras that are numbers; of the end, where
    nothing was decided, they are zero, and all actions legal. Its metadata has the ``agent``, the ``episode`` as the
    place of its seed, and the ``turn`` of its first decision.

    Args:
        dataset_id: What the data set is called, by Minari's rules: ``"(namespace/)name-v0"``.
        trajectories: What ``collect_episodes`` has returned under one key.
        **metadata: As ``minari.create_dataset_from_buffers`` takes it: ``author``, ``description``, ``env`` or
            ``eval_env`` (with which to recover the environment), ``algorithm_name``, ``data_format``, ... Images are
            stored as they are, unless ``jpeg_encoding=True``.

    Returns:
        The ``minari.MinariDataset``. It lies where Minari keeps its data sets, in ``MINARI_DATASETS_PATH``.

    Raises:
        OptionValueError: There is such a data set already, there is nothing to write, or the name is none.
        DefinitionError: It is not known which actions the rule's decisions are.
        MissingExtraError: Minari is missing.
    """
    if not isinstance(trajectories, Trajectories):
        raise OptionValueError(
            f"{dataset_id!r} is to be made of what collect_episodes has returned under one key, not of {trajectories!r}"
        )
    (path,) = _check_free([dataset_id])
    _check_writable(dataset_id, trajectories)
    import minari

    given = {"jpeg_encoding": False, **metadata}
    try:
        with warnings.catch_warnings():
            # Of what else might be told. Whoever is to read the data set knows best whether that is needed.
            warnings.filterwarnings("ignore", r"`\w+` is set to None|env_spec is None")
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                list(_episodes(trajectories, minari.data_collector.EpisodeBuffer)),
                observation_space=trajectories.observation_space,
                action_space=trajectories.action_space,
                **given,
            )
        dataset.storage.update_episode_metadata(_episode_metadata(trajectories))
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)  # half a data set is none
        raise
    return dataset


def _check_free(names: Iterable[str]) -> list[Any]:
    """The paths of data sets that there are not yet."""
    try:
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage.datasets_root_dir import get_dataset_path
    except ImportError as error:
        raise MissingExtraError(f"data sets need Minari: install simenv-marl[minari] ({error})") from None
    paths = []
    for name in names:
        try:
            parse_dataset_id(name)
        except (TypeError, ValueError):
            raise OptionValueError(f'{name!r} is no name of a data set; "namespace/name-v0" is one') from None
        paths.append(get_dataset_path(name))
        if paths[-1].exists():
            raise OptionValueError(
                f"there is a data set {name!r} already, in {paths[-1]}; take another name or version, or delete it"
                " with minari.delete_dataset"
            )
    return paths


def _check_writable(name: str, found: Trajectories) -> None:
    if not len(found):
        raise OptionValueError(f"there is nothing to write to {name!r}: nobody has decided in any episode")
    _check_known(found)


def _episodes(found: Trajectories, buffer: Any) -> Iterable[Any]:
    """Of each trajectory what Minari makes an episode of."""
    infos = _infos(found)
    ends = found.starts + found.lengths
    for place, (start, end) in enumerate(zip(found.starts.tolist(), ends.tolist(), strict=True)):
        own, last = np.arange(start, end), np.array([place])
        seed = found.seeds[found.episodes[start]]
        yield buffer(
            seed=seed if seed < 2**63 else str(seed),  # which Minari reads as an integer all the same
            observations=_listed(joined([taken(found.observations, own), taken(found.last_observations, last)])),
            actions=_listed(taken(found.actions, own)),
            rewards=found.rewards[start:end],
            terminations=found.terminations[start:end],
            truncations=found.truncations[start:end],
            infos={name: joined([taken(values, own), taken(final, last)]) for name, (values, final) in infos.items()},
        )


def _infos(found: Trajectories) -> dict[str, tuple[Any, Any]]:
    """What stands in the infos: of each decision, and of each end."""
    number = len(found.starts)
    infos: dict[str, tuple[Any, Any]] = {"by_rule": (found.by_rule, np.zeros(number, np.bool_))}
    if found.action_masks is not None:
        masks = found.action_masks
        if isinstance(masks, tuple):
            masks = {str(place): part for place, part in enumerate(masks)}
            infos["action_mask"] = masks, {key: np.ones((number, *p.shape[1:]), p.dtype) for key, p in masks.items()}
        else:
            infos["action_mask"] = masks, np.ones((number, *masks.shape[1:]), masks.dtype)
    if found.times is not None and found.elapsed is not None:
        last = found.starts + found.lengths - 1
        infos["time"] = found.times, found.times[last] + found.elapsed[last]
    for name, values in found.extras.items():
        if values.dtype.kind in "biufc":
            infos.setdefault(name, (values, np.zeros((number, *values.shape[1:]), values.dtype)))
    return infos


def _listed(stack: Any) -> Any:
    """A stack, with lists in place of arrays of objects."""
    if isinstance(stack, Mapping):
        return {key: _listed(part) for key, part in stack.items()}
    if isinstance(stack, tuple):
        return tuple(_listed(part) for part in stack)
    return list(stack) if stack.dtype == object else stack


def _episode_metadata(found: Trajectories) -> list[dict[str, Any]]:
    starts = found.starts
    columns = found.agents[starts].tolist(), found.episodes[starts].tolist(), found.turns[starts].tolist()
    return [
        {"agent": found.names[agent], "episode": episode, "turn": turn}
        for agent, episode, turn in zip(*columns, strict=True)
    ]


# -- the rule and a policy ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Comparison:
    """What the model's own rule has decided, and what a policy would have. Made by ``compare_with_rule``.

    Attributes:
        trajectories: What the rule has lived through, and decided.
        policy_actions: Like ``trajectories.actions``: what the policy would have done on the same observation. Where it
            would have left the decision to the rule, the rule's action.
        agreements: ``(N,)`` bool: in which decisions they agree.
    """

    trajectories: Trajectories
    policy_actions: Any
    agreements: NDArray[np.bool_]

    @property
    def agreement(self) -> float:
        """In which share of the decisions they agree; nan of none."""
        return float(self.agreements.mean()) if len(self.agreements) else float("nan")

    def __repr__(self) -> str:
        return f"<Comparison: agreement {self.agreement:.3f} in {len(self.agreements)} decisions>"


def compare_with_rule(
    simulation: Any,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Any = None,
    others: Mapping[Any, Any] | None = None,
    tolerance: float = 0.0,
    **options: Any,
) -> dict[Any, Comparison]:
    """Let the model's own rule decide, and ask policies what they would have done instead.

    At each decision the policy sees what it would see if it decided; then the rule decides. So the episodes are those
    of the plain model, unless there are others.

    Args:
        simulation: As ``collect_episodes`` takes it.
        policies: Who is asked, as ``collect_episodes`` takes them. Whether an action would have been legal, nobody
            checks.
        seeds: What the simulations are reset with.
        points: The decision points, as ``generate_env`` takes them.
        others: Who decides where no rule does, as ``collect_episodes`` takes policies. They are not compared.
        tolerance: By how much numbers in actions may differ for the two to agree; those of ``Box`` spaces of floats.
        **options: As ``collect_episodes`` takes them.

    Returns:
        For each key of ``policies``, the comparison.

    Raises:
        DefinitionError: It is not known which actions the rule's decisions are.
        OptionValueError: An argument cannot have its value.
        InvalidActionError: A policy has not returned one action for each decision.
        SimEnvError: As ``collect_episodes`` does; so are all other errors.
    """
    if not isinstance(policies, Mapping) or not all(callable(policy) for policy in policies.values()):
        raise OptionValueError(f"policies must be a dict from agents or points to callables, not {policies!r}")
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not tolerance >= 0:
        raise OptionValueError(f"tolerance must be a number that is not negative, not {tolerance!r}")
    if others is not None and (not isinstance(others, Mapping) or others.keys() & policies.keys()):
        raise OptionValueError(f"others must be a dict of policies for those who are not compared, not {others!r}")
    by_rule = dict.fromkeys(policies, RULE)
    checked = {name: value for name, value in options.items() if name not in PLAYING}
    _check_knowable(simulation, {**by_rule, **(others or {})}, by_rule, points, checked)
    asked = {id(policy): _Onlooker(policy) for policy in policies.values()}
    onlookers = {key: asked[id(policy)] for key, policy in policies.items()}
    collected = collect_episodes(simulation, {**onlookers, **(others or {})}, seeds=seeds, points=points, **options)
    return {key: _compared(collected[key], float(tolerance)) for key in policies}


class _Onlooker:
    """A policy that notes what another would do, and leaves it to the rule."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self.asked = Asked(policy)

    def __call__(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        noted = np.empty(len(identities), object)
        returned = self.asked.answers(observations, infos, identities)
        for place, action in enumerate(_rows(returned, len(identities), self.policy)):
            noted[place] = action
        return RULE, {"noted": noted}


def _compared(found: Trajectories, tolerance: float) -> Comparison:
    """Make the comparison of what an onlooker has noted."""
    extras = dict(found.extras)
    noted = extras.pop("noted", np.zeros(0)).tolist()
    found = replace(found, extras=extras)
    if not len(found):
        return Comparison(found, found.actions, np.zeros(0, np.bool_))
    _check_known(found)
    assert found.action_space is not None
    actions = [_row(found.actions, row) if action is RULE else action for row, action in enumerate(noted)]
    policy_actions = stacker(found.action_space)(actions)
    return Comparison(found, policy_actions, _agreeing(found.actions, policy_actions, tolerance))


def _row(stack: Any, row: int) -> Any:
    if isinstance(stack, Mapping):
        return {key: _row(part, row) for key, part in stack.items()}
    if isinstance(stack, tuple):
        return tuple(_row(part, row) for part in stack)
    return stack[row]


def _agreeing(one: Any, other: Any, tolerance: float) -> NDArray[np.bool_]:
    """In which rows two stacks agree."""
    if isinstance(one, Mapping):
        return _everywhere([_agreeing(part, other[key], tolerance) for key, part in one.items()])
    if isinstance(one, tuple):
        return _everywhere([_agreeing(*parts, tolerance) for parts in zip(one, other, strict=True)])
    if one.dtype.kind == "f":
        same = np.abs(one - other) <= tolerance
    elif one.dtype == object:
        same = np.array([bool(np.all(mine == theirs)) for mine, theirs in zip(one, other, strict=True)])
    else:
        same = one == other
    return np.asarray(same.reshape(len(one), -1).all(axis=1), np.bool_)


def _everywhere(parts: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    return np.asarray(np.all(parts, axis=0), np.bool_)


# -- whether the rule's actions are known ---------------------------------------------------------


def _check_knowable(
    simulation: Any, policies: Mapping[Any, Any], keys: Iterable[Any], points: Any, options: Mapping[str, Any]
) -> None:
    """Before anything runs: where the rule is going to decide, it must be known which actions its decisions are."""
    plan, places = learners_plan(simulation, policies, points, options)
    for key in keys:
        if not _defers(policies[key]):
            continue
        for binding in plan.bindings.values():
            if isinstance(binding, Binding) and binding.ruled is None and answers(plan, binding, places[key]):
                raise DefinitionError(
                    f"which action the rule of {binding.point.name} takes is not known; give its make_step a"
                    " rule_action_mapping, from the rule's decision to the action that it corresponds to"
                )


def _defers(policy: Any) -> bool:
    """Whether a policy is sure to leave decisions to the rule."""
    if isinstance(policy, Mixture):
        return any(_defers(part) for part, weight in zip(policy.policies, policy.weights, strict=True) if weight)
    return policy is RULE


def _check_known(found: Trajectories) -> None:
    """Afterwards the same, for each decision that was left to the rule."""
    unknown = np.flatnonzero(~found.known)
    if len(unknown):
        agent, seed = found.names[found.agents[unknown[0]]], found.seeds[found.episodes[unknown[0]]]
        raise DefinitionError(
            f"in {len(unknown)} of {len(found)} decisions it is not known which action the rule has taken, first in"
            f" that of {agent!r} at turn {found.turns[unknown[0]]} of the episode of seed {seed}; its decision point"
            " needs a rule_action_mapping that returns an action for every decision of the rule"
        )
