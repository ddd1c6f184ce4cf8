"""Wrappers of Gymnasium around the single view.

Some need packages that only ``make test-wrappers`` installs.
"""

import copy
from typing import Any, NamedTuple

import numpy as np
import pytest
from gymnasium import wrappers

from tests.worlds.vectors import DialEnv, alike, dial_env


class Case(NamedTuple):
    """The making of a wrapper: its arguments, its required observations, its required packages."""

    arguments: dict[str, Any] = {}  # noqa: RUF012 - it is never changed
    seen: str = "numbers"
    needs: tuple[str, ...] = ()
    render_mode: str | None = None


def drawn(*needs, **arguments):
    return Case(arguments, needs=needs, render_mode="rgb_array")


def halved(value):
    return value / 2


WRAPPERS = {
    "ArrayConversion": Case(
        {"env_xp": "numpy", "target_xp": "torch"}, needs=("array_api_compat", "torch")
    ),
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


@pytest.mark.parametrize(("name", "case"), WRAPPERS.items(), ids=WRAPPERS)
def test_gymnasium_wrappers_work_as_around_an_env_written_by_hand(
    name, case, tmp_path, monkeypatch
):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    packages = {package: pytest.importorskip(package) for package in case.needs}

    def told_by(make):
        env = wrappers.TimeLimit(make(case.seen, render_mode=case.render_mode), 9)
        special = packages | {"numpy": np, "a folder": str(tmp_path / type(env.unwrapped).__name__)}
        arguments = {
            key: special.get(value, value) if isinstance(value, str) else value
            for key, value in case.arguments.items()
        }
        wrapped = getattr(wrappers, name)(env, **arguments)
        assert wrapped.unwrapped is env.unwrapped
        told = [wrapped.observation_space, wrapped.action_space, wrapped.reset(seed=3)]
        actions = copy.deepcopy(wrapped.action_space)
        actions.seed(1)
        for number in range(14):
            action = actions.sample()
            results = wrapped.step(
                packages["torch"].from_numpy(action) if "torch" in packages else action
            )
            told.append(results)
            if case.render_mode is not None:
                told.append(wrapped.render())
            if name != "Autoreset" and (results[2] or results[3]):
                told.append(wrapped.reset(seed=number))
        wrapped.close()
        return told

    assert alike(told_by(dial_env), told_by(DialEnv))
