"""All wrappers of Gymnasium: around our views they tell what they tell around environments written by hand.

And those of PettingZoo that make films.

Some need packages that only ``make test-wrappers`` installs.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.vector import SyncVectorEnv
from pettingzoo.utils.wrappers import RecordVideo, RecordVideoParallel

from simenv_marl import aec_env, parallel_env
from tests.worlds.counters import alike
from tests.worlds.dials import DialEnv, DialSim, dial_env, dial_envs, points


class Case(NamedTuple):
    """How a wrapper is made: its arguments, what it wants to be seen, and the packages that it needs."""

    arguments: dict[str, Any] = {}  # noqa: RUF012 - it is never changed
    seen: str = "numbers"
    needs: tuple[str, ...] = ()
    render_mode: str | None = None


def drawn(*needs: str, **arguments: Any) -> Case:
    return Case(arguments, needs=needs, render_mode="rgb_array")


def halved(value: Any) -> Any:
    return value / 2


BOTH = {
    "ArrayConversion": Case({"env_xp": "numpy", "target_xp": "torch"}, needs=("array_api_compat", "torch")),
    "ClipAction": Case(),
    "ClipReward": Case({"min_reward": 0.5, "max_reward": 1.5}),
    "DtypeObservation": Case({"dtype": np.int16}),
    "FilterObservation": Case({"filter_keys": ["place"]}, "parts"),
    "FlattenObservation": Case({}, "parts"),
    "GrayscaleObservation": Case({}, "picture"),
    "HumanRendering": drawn("pygame", "cv2"),
    "NormalizeObservation": Case(),
    "NormalizeReward": Case(),
    "NumpyToTorch": Case(needs=("array_api_compat", "torch")),
    "RecordEpisodeStatistics": Case(),
    "RecordVideo": drawn("moviepy", video_folder="a folder"),
    "RescaleAction": Case({"min_action": np.float32(0), "max_action": np.float32(1)}),
    "RescaleObservation": Case({"min_obs": np.float32(0), "max_obs": np.float32(1)}),
    "ReshapeObservation": Case({"shape": (2, 2)}),
    "ResizeObservation": Case({"shape": (3, 2)}, "picture", ("cv2",)),
    "TransformAction": Case({"func": halved, "action_space": None}),
    "TransformObservation": Case({"func": halved, "observation_space": None}),
    "TransformReward": Case({"func": halved}),
}
ALONE = BOTH | {
    "AddRenderObservation": drawn(),
    "AddWhiteNoise": drawn(probability_of_noise_per_pixel=0.5),
    "Autoreset": Case(),
    "DelayObservation": Case({"delay": 2}),
    "DiscretizeAction": Case({"bins": 3}),
    "DiscretizeObservation": Case({"bins": 4}),
    "FrameStackObservation": Case({"stack_size": 3}),
    "MaxAndSkipObservation": Case({"skip": 2}, "picture"),
    "ObstructView": drawn(obstructed_pixels_ratio=0.5, obstruction_width=2),
    "OrderEnforcing": Case(),
    "PassiveEnvChecker": Case(),
    "RenderCollection": drawn(),
    "RepeatAction": Case({"num_repeats": 2}),
    "StickyAction": Case({"repeat_action_probability": 0.5}),
    "TimeAwareObservation": Case(),
    "TimeLimit": Case({"max_episode_steps": 3}),
}
MANY = BOTH | {
    "DictInfoToList": Case(),
    "VectorizeTransformAction": Case({"wrapper": wrappers.ClipAction}),
    "VectorizeTransformObservation": Case(
        {"wrapper": wrappers.RescaleObservation, "min_obs": np.float32(0), "max_obs": np.float32(1)}
    ),
    "VectorizeTransformReward": Case({"wrapper": wrappers.ClipReward, "max_reward": 1.5}),
}
FOR_OTHERS = {
    "AtariPreprocessing",  # asks for the Atari emulator
    "JaxToNumpy",  # around environments that compute with JAX
    "JaxToTorch",
}


def test_no_wrapper_is_left_out():
    assert set(wrappers.__all__) - {"vector"} == ALONE.keys() | FOR_OTHERS
    assert set(wrappers.vector.__all__) == MANY.keys() | FOR_OTHERS - {"AtariPreprocessing"}


@pytest.fixture
def wrap(tmp_path, monkeypatch):
    """Puts an environment into the wrapper of a module, and tells what that tells."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")

    def story(module: Any, name: str, case: Case, env: Any) -> list[Any]:
        packages = {package: pytest.importorskip(package) for package in case.needs}
        special = packages | {"numpy": np, "a folder": str(tmp_path / type(env.unwrapped).__name__)}
        arguments = {
            key: special.get(value, value) if isinstance(value, str) else value for key, value in case.arguments.items()
        }
        wrapped = getattr(module, name)(env, **arguments)
        assert wrapped.unwrapped is env.unwrapped
        told = [wrapped.observation_space, wrapped.action_space, wrapped.reset(seed=3)]
        actions = copy.deepcopy(wrapped.action_space)
        actions.seed(1)
        for number in range(14):
            action = actions.sample()
            results = wrapped.step(packages["torch"].from_numpy(action) if "torch" in packages else action)
            told.append(results)
            if case.render_mode is not None:
                told.append(wrapped.render())
            if module is wrappers and name != "Autoreset" and (results[2] or results[3]):
                told.append(wrapped.reset(seed=number))
        wrapped.close()
        return told

    return story


@pytest.mark.parametrize(("name", "case"), ALONE.items(), ids=ALONE)
def test_around_one(name, case, wrap):
    one, other = (
        wrap(wrappers, name, case, wrappers.TimeLimit(make(case.seen, render_mode=case.render_mode), 9))
        for make in (dial_env, DialEnv)
    )
    assert alike(one, other)


@pytest.mark.parametrize(("name", "case"), MANY.items(), ids=MANY)
def test_around_many(name, case, wrap):
    def by_hand(seen, **options):
        return SyncVectorEnv([lambda: DialEnv(seen, **options)] * 2)

    one, other = (
        wrap(wrappers.vector, name, case, make(case.seen, render_mode=case.render_mode))
        for make in (dial_envs, by_hand)
    )
    assert alike(one, other)


@pytest.mark.parametrize("parallel", [False, True])
def test_films_by_pettingzoo(parallel, tmp_path):
    pytest.importorskip("moviepy")
    view, wrapper = (parallel_env, RecordVideoParallel) if parallel else (aec_env, RecordVideo)
    env = wrapper(view(DialSim, points("numbers"), render_mode="rgb_array"), str(tmp_path / "films"))
    env.reset(seed=1)
    while env.agents:
        over = not parallel and any(env.last()[2:4])
        action = None if over else np.ones(2, np.float32)
        env.step({"hand_0": action} if parallel else action)
    env.close()
    assert [path.suffix for path in (tmp_path / "films").iterdir()] == [".mp4"]
