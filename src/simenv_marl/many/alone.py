"""Runs whose process has died: each is repeated in a process without others."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from typing import Any

from ..core import pack_outcome


def run_alone(task: tuple[Any, ...], items: Sequence[Any], processes: int) -> list[bytes | None]:
    """Work on each item in a process without others, because they may not be to blame.

    Return the outcomes; None for one whose process has died twice.
    """
    if not items:
        return []
    loky = import_module("joblib.externals.loky")
    pools = [loky.ProcessPoolExecutor(1) for _ in range(min(processes, len(items)))]
    idle = [*pools]

    def run(item: Any) -> bytes | None:
        pool = idle.pop()
        outcome = None
        for _ in range(2):
            try:
                outcome = pool.submit(pack_outcome, *task, [item]).result()
                break
            except BrokenProcessPool:
                pool = loky.ProcessPoolExecutor(1)
                pools.append(pool)
        idle.append(pool)
        return outcome

    with ThreadPoolExecutor(len(pools)) as threads:
        try:
            return list(threads.map(run, items))
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            for pool in pools:
                pool.shutdown(kill_workers=True)
