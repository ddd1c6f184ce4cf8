"""The time of one AEC decision by stages, from the bare switch to ``env.step`` and ``last``.

A section of ``benchmarks.core``. Each row is the time up to and including that stage. The last rows show the effect of
a switch of stacks on the code after it, which no stage can avoid: NumPy makes an array more slowly after a switch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.decisions import bare_greenlet
from benchmarks.measure import Contender, Section, side_by_side, timed
from benchmarks.noop import Model, Turns
from simenv_marl import aec_env


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
    env: Any = aec_env(Turns, [Model.left, Model.right])
    env.reset(seed=0)
    episode = env.unwrapped._session.episode
    bare, resume, values = bare_greenlet().switch, episode.driver.resume, np.zeros(4, np.float32)

    def handle() -> None:
        event, args, kwargs = resume(1)
        event.handle(episode, args, kwargs)

    def array_after_switch() -> None:
        bare()
        np.array(values)

    def last() -> None:
        env.step(1)
        env.last()

    stages = {
        "an empty call": lambda: None,
        "a bare switch there and back": bare,
        "driver.resume: the model goes on and decides again": lambda: resume(1),
        "and event.handle: reward, info and observation": handle,
        "Episode.step: the action checked and mapped, too": lambda: episode.step(1),
        "env.step": lambda: env.step(1),
        "env.step and env.last": last,
        "an array made": lambda: np.array(values),
        "a bare switch, and an array made after it": array_after_switch,
    }
    times = side_by_side({name: _calls(stage, number) for name, stage in stages.items()}, rounds)
    env.close()
    section = Section("Stages of an AEC decision, each with those above it", "microseconds per decision")
    section.times(times)
    return section


def _calls(stage: Any, number: int) -> Contender:
    def loop(number: int) -> None:
        for _ in range(number):
            stage()

    return timed(loop, number)
