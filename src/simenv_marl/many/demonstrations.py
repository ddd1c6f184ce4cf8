"""Demonstrations: what the model's own rule, or policies, have done, as data sets for learners that imitate it.

Everything here is ``collect_episodes`` and what is made of its ``Trajectories``. Minari is only imported where a data
set is written.
"""

import shutil
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, Unpack

import numpy as np

from ..core.options import EpisodeOptions
from ..core.points import Points
from ..core.provenance import provenance
from ..core.stacking import joined, taken
from ..errors import MissingExtraError, OptionValueError, meant, shown
from .collect import collect_episodes
from .mixture import name_of
from .rule_actions import check_knowable, check_known
from .trajectories import Trajectories

__all__ = ["record_dataset", "save_dataset"]


def record_dataset(
    dataset_id: str | Mapping[Any, str],
    simulation: Any,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Points = None,
    metadata: Mapping[str, Any] | None = None,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
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
        The ``minari.MinariDataset``; where ``dataset_id`` is a dict, a dict of these. An error or an interrupt leaves
        none of them behind.

    Raises:
        OptionValueError: There is such a data set already, or an argument cannot have its value.
        DefinitionError: It is not known which actions the rule's decisions are.
        MissingExtraError: Minari is missing.
        SimEnvError: As ``collect_episodes`` does; so are all other errors.
    """
    if not isinstance(policies, Mapping) or not policies:
        raise OptionValueError(f"policies must be a dict from agents or points to policies, not {shown(policies)}")
    names = _dataset_ids(dataset_id, policies)
    _check_free(names.values())
    check_knowable(simulation, policies, names, points, options)
    sizes: dict[str, Any] = {"batch_size": batch_size, "workers": workers, "progress": progress}
    collected = collect_episodes(simulation, policies, seeds=seeds, points=points, **sizes, **options)
    for key, name in names.items():
        _check_writable(name, collected[key])
    origin = provenance(simulation, points, **options)
    written, begun = {}, list[Any]()
    try:
        for key, name in names.items():
            begun += _check_free([name])
            given = {"algorithm_name": name_of(policies[key]), **(metadata or {})}
            written[key] = save_dataset(name, collected[key], **given)
            written[key].storage.update_metadata({"provenance": origin})
    except BaseException:
        for path in begun:
            shutil.rmtree(path, ignore_errors=True)  # all of them or none
        raise
    return written if isinstance(dataset_id, Mapping) else next(iter(written.values()))


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
        raise OptionValueError(f"dataset_id must be a name, or a dict of names, not {shown(dataset_id)}")
    unknown = [key for key in dataset_id if key not in policies]
    if unknown:
        raise OptionValueError(
            f"dataset_id names {shown(unknown[0])}, for whom there is no policy{meant(unknown[0], map(str, policies))}"
        )
    if len(set(dataset_id.values())) < len(dataset_id):
        raise OptionValueError(f"each policy needs a data set of its own: {shown(dict(dataset_id))}")
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
            f"{shown(dataset_id)} is to be made of what collect_episodes has returned under one key, not of"
            f" {shown(trajectories)}"
        )
    (path,) = _check_free([dataset_id])
    _check_writable(dataset_id, trajectories)
    import minari

    given = {"jpeg_encoding": False, **metadata}
    try:
        with warnings.catch_warnings():
            # Of metadata that is missing. Users know best whether readers of the data set need it.
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
            raise OptionValueError(f'{shown(name)} is no name of a data set; "namespace/name-v0" is one') from None
        paths.append(get_dataset_path(name))
        if paths[-1].exists():
            raise OptionValueError(
                f"there is a data set {shown(name)} already, in {paths[-1]}; take another name or version, or delete it"
                " with minari.delete_dataset"
            )
    return paths


def _check_writable(name: str, found: Trajectories) -> None:
    if not len(found):
        raise OptionValueError(f"there is nothing to write to {shown(name)}: no agent has decided in any episode")
    check_known(found)


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
