"""The cost of a step of an OpenEnv client on the loopback address, beside a step without a server.

It needs the extra ``openenv``. Times are wall-clock times of two cores, because the server has a
thread of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec

from examples.greenhouse_coop.env import DAYS, GreenhouseSim

from benchmarks.episodes import less
from benchmarks.measure import Group, MissingError, Row, timer, two_cores
from simenv_marl import single_env

WATERING = partial(single_env, GreenhouseSim, agent="waterer_0")


def groups(number: int) -> Iterator[Group]:
    """Yield the row. Each contender plays most of an episode; ``number`` has no effect."""
    if find_spec("openenv") is None:
        raise MissingError("the extra openenv")
    import uvicorn
    from openenv.core.generic_client import GenericEnvClient

    from simenv_marl.seats.openenv import serve

    config = uvicorn.Config(serve(WATERING, name="greenhouse"), port=0, log_level="error")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    with two_cores():
        thread.start()
        try:
            while not server.started:
                time.sleep(0.01)
            url = f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
            with GenericEnvClient(base_url=url).sync() as client:
                served = steps(client.reset, lambda: client.step({"action": 0.05}))
                env = WATERING()
                own = steps(env.reset, lambda: env.step([0.05]))
                row = "a step of an OpenEnv client / a step of its environment"
                more = Row(f"{row}, less", less(served, own), bar=3_000.0)
                yield Group([Row(row, served, own), more], most=20)
        finally:
            server.should_exit = True
            thread.join()


def steps(reset: Callable[..., object], step: Callable[[], object]) -> Callable[[], float]:
    """Make a contender: the steps of most of an episode."""

    def play(number: int) -> None:
        reset(seed=1)
        for _ in range(number):
            step()

    return timer(play, DAYS - 10, time.perf_counter)
