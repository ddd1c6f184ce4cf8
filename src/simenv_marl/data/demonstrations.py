"""Minari data sets of the decisions of the model's rule or of policies.

They serve imitation and offline learning, and consist of the ``Trajectories`` that
``collect_episodes`` returns. Minari is imported only when a data set is written.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from ..core import EpisodeOptions, Points, joined, provenance, taken
from ..errors import (
    MissingExtraError,
    OptionValueError,
    did_you_mean,
    short_repr,
)
from ..runs import checked_policies
from ..simulation import Model
from .collect import (
    LeftToRule,
    Policies,
    check_known,
    collect_episodes,
    follows_rule,
    policy_name,
)
from .trajectories import Array, Integers, Trajectories

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer


def record_dataset(
    dataset_id: str | Mapping[Any, str],
    simulation: Model,
    policies: Policies,
    *,
    seeds: Iterable[int],
    points: Points = None,
    metadata: Mapping[str, Any] | None = None,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> Any:
    """Play one episode per seed, and write the decisions as a Minari data set for offline learning.

    A data set has the decisions of one policy. Each episode in it is the trajectory of one agent:
    the agent of the single view, or one of many agents that share the policy. ``save_dataset``
    describes the contents.

    Args:
        dataset_id: The name of the data set, such as ``"greenhouse/rule-v0"``. With several
            policies: a dict from their keys to such names. Policies without a name decide, but are
            not recorded.
        simulation: As ``simulate_many`` takes it.
        policies: The policies: ``RULE``, a callable, or a ``Mixture``, as ``collect_episodes``
            takes them. The rule's decisions are known as actions if the point has a
            ``rule_action_mapping`` or needs none.
        seeds: As ``simulate_many`` takes them.
        points: As ``simulate_many`` takes them.
        metadata: Metadata for Minari: see ``save_dataset``. ``algorithm_name`` defaults to the name
            of the policy. The result of ``provenance`` is always added.
        batch_size: As ``simulate_many`` takes it.
        workers: As ``simulate_many`` takes them.
        progress: As ``simulate_many`` takes it.
        **options: The options of ``aec_env``.

    Returns:
        The ``minari.MinariDataset``. If ``dataset_id`` is a dict: a dict of data sets. After an
        error or an interrupt, none of them is left on disk.

    Raises:
        BaseException: Any error of ``collect_episodes`` or ``save_dataset``. Errors in the
            arguments are raised before anything runs, where possible.
    """
    policies = checked_policies(policies)
    names = _dataset_ids(dataset_id, policies)
    paths = [_free_path(name) for name in names.values()]
    to_rule = {key: LeftToRule(policies[key]) for key in names if follows_rule(policies[key])}
    collected = collect_episodes(
        simulation,
        {**policies, **to_rule},
        seeds=seeds,
        points=points,
        batch_size=batch_size,
        workers=workers,
        progress=progress,
        **options,
    )
    origin = provenance(simulation, points, **options)
    datasets = {}
    try:
        for key, name in names.items():
            datasets[key] = save_dataset(
                name,
                collected[key],
                **{"algorithm_name": policy_name(policies[key]), **(metadata or {})},
            )
            datasets[key].storage.update_metadata({"provenance": origin})
    except BaseException:
        for path in paths:
            shutil.rmtree(path, ignore_errors=True)  # all of them or none
        raise
    return datasets if isinstance(dataset_id, Mapping) else next(iter(datasets.values()))


def _dataset_ids(
    dataset_id: str | Mapping[Any, str],
    policies: Policies,
) -> Mapping[Any, str]:
    """Return the name of each data set, by the key of its policy."""
    names = dataset_id
    if isinstance(dataset_id, str):
        names = dict.fromkeys(policies, dataset_id)
    if (
        not isinstance(names, Mapping)
        or not names
        or not all(isinstance(name, str) for name in names.values())
        or len(set(names.values())) < len(names)
    ):
        raise OptionValueError(
            f"dataset_id must be a name, or for {len(policies)} policies a dict that gives each its"
            f" own name, not {short_repr(dataset_id)}"
        )
    for key in names:
        if key not in policies:
            raise OptionValueError(
                f"dataset_id names {short_repr(key)}, which has no policy"
                f"{did_you_mean(key, map(str, policies))}"
            )
    return names


def save_dataset(
    dataset_id: str,
    trajectories: Trajectories,
    **metadata: Any,
) -> MinariDataset:
    """Write the decisions of one policy as a Minari data set.

    Each trajectory becomes an episode, with its seed. An episode has one more observation than
    actions; the last one is the agent's final observation. Terminations and truncations follow
    Gymnasium. The infos have one row per observation: ``by_rule``, ``action_mask``, ``time`` and
    ``state`` where they exist, and all numeric extras. In the row of the final observation, where
    nothing was decided, extras are zero, and all actions are legal. The episode's metadata has the
    ``agent``, the ``episode`` (the index of its seed), and the ``turn`` of its first decision.

    Args:
        dataset_id: The name of the data set, by Minari's rules: ``"(namespace/)name-v0"``.
        trajectories: The trajectories that ``collect_episodes`` returned under one key.
        **metadata: As ``minari.create_dataset_from_buffers`` takes it: ``author``, ``description``,
            ``env`` or ``eval_env`` (to recover the environment),
            ``algorithm_name``, ``data_format``, ... Images are stored as they are, unless
            ``jpeg_encoding=True``.

    Returns:
        The ``minari.MinariDataset``. It is stored in Minari's folder, ``MINARI_DATASETS_PATH``.

    Raises:
        OptionValueError: The data set exists already, there are no decisions to write, or the name
            is invalid.
        DefinitionError: The actions that correspond to the rule's decisions are unknown.
        MissingExtraError: Minari is missing.
    """
    if not isinstance(trajectories, Trajectories):
        raise OptionValueError(
            f"the data set {short_repr(dataset_id)} needs Trajectories, as collect_episodes"
            f" returns them under each key, not {short_repr(trajectories)}"
        )
    path = _free_path(dataset_id)
    if not len(trajectories):
        raise OptionValueError(
            f"there is nothing to write to {short_repr(dataset_id)}: no agent has decided in any"
            " episode"
        )
    check_known(trajectories)
    import minari

    try:
        with warnings.catch_warnings():
            # Minari warns of missing metadata, but not every data set needs them.
            warnings.filterwarnings("ignore", r"`\w+` is set to None|env_spec is None")
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                list(_episodes(trajectories)),
                observation_space=trajectories.observation_space,
                action_space=trajectories.action_space,
                **{"jpeg_encoding": False, **metadata},
            )
        dataset.storage.update_episode_metadata(
            {
                "agent": trajectories.names[trajectories.agents[start]],
                "episode": int(trajectories.episodes[start]),
                "turn": int(trajectories.turns[start]),
            }
            for start in trajectories.starts
        )
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)  # never leave half a data set
        raise
    return dataset


def _free_path(name: str) -> Path:
    """Return the path of a data set that does not exist yet."""
    try:
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage.datasets_root_dir import get_dataset_path
    except ImportError as error:
        raise MissingExtraError(
            f"data sets need Minari: install simenv-marl[minari] ({error})"
        ) from None
    try:
        parse_dataset_id(name)
    except (TypeError, ValueError):
        raise OptionValueError(
            f'{short_repr(name)} is not a name for a data set; a valid one is "namespace/name-v0"'
        ) from None
    path = Path(get_dataset_path(name))
    if path.exists():
        raise OptionValueError(
            f"the data set {short_repr(name)} exists already, in {path}; take another name or"
            " version, or delete it with minari.delete_dataset"
        )
    return path


def _episodes(trajectories: Trajectories) -> Iterator[EpisodeBuffer]:
    """Make a Minari episode of each trajectory."""
    from minari.data_collector import EpisodeBuffer

    for place, start in enumerate(trajectories.starts):
        rows = np.arange(start, start + trajectories.lengths[place])
        seed = trajectories.seeds[trajectories.episodes[start]]
        last_observation = taken(trajectories.last_observations, np.array([place]))
        yield EpisodeBuffer(
            seed=seed if seed < 2**63 else str(seed),  # Minari reads the string as an integer
            observations=joined([taken(trajectories.observations, rows), last_observation]),
            actions=taken(trajectories.actions, rows),
            rewards=trajectories.rewards[rows],
            terminations=trajectories.terminations[rows],
            truncations=trajectories.truncations[rows],
            infos=_infos(trajectories, rows, np.array([place])),
        )


def _infos(trajectories: Trajectories, rows: Integers, place: Integers) -> dict[str, Any]:
    """Return the infos of a trajectory, with a row for each decision and one for the end."""
    infos: dict[str, Any] = {
        name: _extend(values[rows], 0)
        for name, values in trajectories.extras.items()
        if values.dtype.kind in "biufc"
    }
    infos["by_rule"] = _extend(trajectories.by_rule[rows], False)
    masks = trajectories.action_masks
    if isinstance(masks, tuple):
        infos["action_mask"] = {
            str(place): _extend(mask[rows], 1) for place, mask in enumerate(masks)
        }
    elif masks is not None:
        infos["action_mask"] = _extend(masks[rows], 1)
    if trajectories.states is not None:
        ends = taken(trajectories.last_states, place)
        infos["state"] = joined([taken(trajectories.states, rows), ends])
    if trajectories.times is not None and trajectories.elapsed is not None:
        times = trajectories.times[rows]
        infos["time"] = np.append(times, times[-1] + trajectories.elapsed[rows[-1]])
    return infos


def _extend(values: Array, filler: int) -> Array:
    """Append a row that consists of a filler."""
    return np.concatenate([values, np.full_like(values[:1], filler)])
