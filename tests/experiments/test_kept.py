"""Evaluations with a store: finished episodes are kept, and a second call goes on."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from itertools import product

import pandas as pd
import pytest

from simenv_marl import evaluate
from simenv_marl.errors import AgentError, OptionValueError, StoreError
from simenv_marl.experiments import Variant, run_experiment
from simenv_marl.seats import FallbackPolicy
from tests.experiments.test_runs import ROOT, lines, visits
from tests.experiments.test_wrong_numbers import BET, Casino
from tests.worlds.entities import beings
from tests.worlds.models import plainly
from tests.worlds.valued import POINTS, Shop, level, much, much_of_many, some, some_of_many

KILLS = int(os.environ.get("KEPT_KILLS", "3"))
"""How many times an evaluation is killed. The bar is 200."""

CONTENDERS = {"rule": {}, "much": {"keeper": much}, "some": {"keeper": some}}
OF_MANY = {"rule": {}, "much": {"keeper": much_of_many}, "some": {"keeper": some_of_many}}
MANY = {"contenders": OF_MANY, "batched": True}


def run(store, simulation=Shop, **arguments):
    given = {
        "contenders": CONTENDERS,
        "seeds": range(4),
        "points": POINTS,
        "metric": {"level": level},
        "baseline": "rule",
        **arguments,
    }
    return evaluate(simulation, store=store, **given)


def keys(store):
    return [(line["contender"], line["seed"]) for line in lines(store)]


def whole_lines(path):
    return path.read_bytes().split(b"\n")[:-1]


def end_at(seed, error=KeyboardInterrupt):
    """A shop that ends with an error for one seed, and a list of the seeds that have run."""
    begun = []

    class Ending(Shop):
        def run(self):
            begun.append(self.seed)
            if self.seed == seed:
                raise error
            super().run()

    return Ending, begun


@pytest.mark.parametrize(
    "arguments",
    [{}, {"workers": 2}, MANY, MANY | {"batch_size": 2}, MANY | {"workers": 2}, {"width": 50.0}],
    ids=plainly,
)
def test_evaluate_with_a_store_equals_evaluate_without(arguments, tmp_path, capsys):
    arguments = {"seeds": range(20)} | arguments
    plain = run(None, **arguments)
    number = 3 * len(plain.values())
    for _ in range(2):
        kept = run(tmp_path, progress=True, **arguments)
        assert kept.frame.equals(plain.frame)
        assert kept.seats.drop(columns="seconds").equals(plain.seats.drop(columns="seconds"))
        assert len(lines(tmp_path)) == len(set(keys(tmp_path))) == number
    assert capsys.readouterr().err.count(f"{number}/60") >= 2


def test_evaluate_with_a_store_runs_only_new_seeds_and_contenders(tmp_path):
    shop, begun = end_at(None)
    few = {"rule": {}, "much": {"keeper": much}}
    run(tmp_path, shop, contenders=few)
    assert begun == 2 * [*range(4)]
    begun.clear()
    found = run(tmp_path, shop, seeds=range(2, 6))
    assert begun == 2 * [4, 5] + [2, 3, 4, 5]
    assert found.frame.equals(run(None, seeds=range(2, 6)).frame)
    assert run(tmp_path, shop, contenders=few, seeds=[0]).frame["seed"].unique().tolist() == [0]
    assert len(begun) == 8


def test_evaluate_progress_bar_begins_with_the_stored_episodes(tmp_path, capsys):
    run(tmp_path)
    run(tmp_path, seeds=range(6), progress=True)
    shown = capsys.readouterr().err
    assert " 12/18 [00:00<?, ?episode/s]" in shown  # and the rate is that of the others
    assert " 18/18 " in shown


def test_evaluate_store_keeps_counts_of_fallback_policies(tmp_path):
    def late(observation):
        raise ValueError

    contenders = {"late": {"keeper": FallbackPolicy(late, fallback=some)}}
    kept = [run(tmp_path, contenders=contenders, baseline=None) for _ in range(2)]
    assert kept[0].frame.equals(kept[1].frame)
    assert kept[0].seats.equals(kept[1].seats)
    assert kept[1].seats["fallbacks"].tolist() == [12, 0]
    assert kept[1].seats["seconds"].gt(0).tolist() == [True, False]


@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, MANY | {"batch_size": 1}], ids=plainly)
@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError, TimeoutError])
def test_evaluate_store_keeps_finished_runs_after_interrupts_and_errors(error, arguments, tmp_path):
    if error is KeyboardInterrupt and "workers" in arguments:
        pytest.skip("an interrupt reaches the parent; the kills below end workers")
    shop, begun = end_at(2, error)
    with pytest.raises(error) as caught:
        run(tmp_path, shop, **arguments | {"contenders": {"rule": {}}})
    assert f"runs are kept in {tmp_path}; the same call" in "".join(caught.value.__notes__)
    known = keys(tmp_path)
    assert ("rule", 2) not in known
    if not arguments.get("workers"):
        assert begun == [0, 1, 2]
        assert known == [("rule", 0), ("rule", 1)]
    mended, begun = end_at(None)
    mended.__qualname__ = shop.__qualname__
    found = run(tmp_path, mended, contenders={"rule": {}}, batched="batched" in arguments)
    assert begun == [seed for seed in range(4) if ("rule", seed) not in known]
    assert found.frame.equals(run(None, contenders={"rule": {}}).frame)


def test_evaluate_store_runs_the_episode_of_a_torn_line_again(tmp_path):
    whole = run(tmp_path)
    (path,) = tmp_path.glob("*.jsonl")
    path.write_bytes(path.read_bytes()[:-9])
    shop, begun = end_at(None)
    shop.__qualname__, shop.__module__ = "Shop", Shop.__module__
    assert run(tmp_path, shop).frame.equals(whole.frame)
    assert begun == [3]
    assert len(keys(tmp_path)) == 12


def test_evaluate_store_line_is_written_by_the_process_that_ran_it(tmp_path):
    run(tmp_path, workers=2, metric=lambda shop: os.getpid(), seeds=range(8))
    for path in tmp_path.glob("*.jsonl"):
        for line in path.read_text().splitlines():
            assert f"{json.loads(line)['metrics']['metric']:x}" in path.stem.split("-")[2]
    assert len(keys(tmp_path)) == 24


def test_evaluate_refuses_a_store_of_other_metrics_or_experiments(tmp_path):
    shop, begun = end_at(None)
    run(tmp_path / "own")
    experiment = {"seeds": [0], "points": POINTS, "metric": {"level": level}}
    for name, design in (("days", {"days": [1]}), ("none", [{}])):
        run_experiment(Shop, design, store=tmp_path / name, **experiment)
        with pytest.raises(OptionValueError, match=r"belongs to another .*factors are \["):
            run(tmp_path / name, shop)
        with pytest.raises(OptionValueError, match=r"belongs to another .*factors are None"):
            run_experiment(Shop, design, store=tmp_path / "own", **experiment)
    with pytest.raises(OptionValueError, match=r"metrics are \['level'\], not \['other'\]"):
        run(tmp_path / "own", shop, metric={"other": level})
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("")
    with pytest.raises(OptionValueError, match="not the store of an experiment or evaluation"):
        run(tmp_path / "thesis", shop)
    with pytest.raises(StoreError, match="cannot be made or read"):
        run(tmp_path / "thesis" / "thesis.tex", shop)
    assert begun == []


def test_evaluate_with_invalid_arguments_creates_no_store(tmp_path):
    for arguments in ({"baseline": "x"}, {"contenders": {"a": {"nobody.at": some}}}, {"team": 3}):
        with pytest.raises((OptionValueError, ValueError, LookupError)):
            run(tmp_path / "store", **arguments)
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    ("told", "arguments"),
    [
        (r"simulation .*Shop.* then, .*Other.* now", {"simulation": type("Other", (Shop,), {})}),
        (r'options {} then, {"max_steps": 2} now', {"max_steps": 2}),
        (r"points .*helper.* then", {"points": {Shop.order: POINTS[Shop.order]}}),
        (
            r"'much' .*policies .*much.* then",
            {"contenders": CONTENDERS | {"much": {"keeper": some}}},
        ),
        (r"variant null then, v now", {"simulation": Variant("v", Shop)}),
    ],
)
def test_evaluate_warns_if_stored_runs_had_other_definitions(told, arguments, tmp_path):
    first = run(tmp_path)
    with pytest.warns(UserWarning, match=told):
        frame = run(tmp_path, baseline=None, **arguments).frame
    same = first.frame["contender"].isin(frame["contender"])
    assert frame.equals(first.frame[same].reset_index(drop=True))


@pytest.mark.thorough
def test_evaluate_does_not_warn_if_stored_runs_had_equal_definitions(tmp_path):
    run(tmp_path, lambda: Shop(2), workers=2, driver="thread")
    run(tmp_path, lambda: Shop(2), points=dict(reversed(POINTS.items())))
    assert len(keys(tmp_path)) == 12


def test_evaluate_store_repeats_runs_with_wrong_numbers(tmp_path):
    class Fresh(Casino):
        """One of which nobody was warned yet."""

    given = {"seeds": range(2), "points": BET, "store": tmp_path}
    with pytest.warns(UserWarning, match="global"):
        assert set(evaluate(Fresh, {"rule": {}}, **given).frame["status"]) == {"error"}
    mended = evaluate(Fresh, {"rule": {}}, global_rng=True, **given)
    assert "status" not in mended.frame
    assert mended.frame.equals(evaluate(Fresh, {"rule": {}}, **given, global_rng=True).frame)
    assert len(keys(tmp_path)) == 4


def test_evaluate_computes_the_team_return_anew_from_its_store(tmp_path):
    with pytest.raises(KeyError, match=r"'stranger' .*did not decide") as caught:
        run(tmp_path, team=lambda returns: returns["stranger"])
    assert "of the contender 'rule'; seed 0" in "".join(caught.value.__notes__)
    shop, begun = end_at(None)
    shop.__qualname__, shop.__module__ = "Shop", Shop.__module__
    team = {"team": lambda returns: returns.max()}
    assert run(tmp_path, shop, **team).frame.equals(run(None, **team).frame)
    assert begun == []


@pytest.mark.filterwarnings("ignore:policies= or possible_agents= name agents")
@pytest.mark.parametrize("workers", [0, 2])
def test_evaluate_refuses_a_misnamed_agent_and_stores_none_of_its_runs(workers, tmp_path):
    contenders = {"right": {"being_1": much}, "wrong": {"beeing_1": much}}
    given = {"seeds": range(3), "points": beings(), "store": tmp_path, "workers": workers}
    with pytest.raises(AgentError, match="'wrong' has a policy for 'beeing_1'"):
        evaluate(visits, contenders, **given)
    assert "wrong" not in dict(keys(tmp_path))
    contenders["wrong"] = contenders["right"]
    frame = evaluate(visits, contenders, **given).frame
    assert frame.groupby("contender")["return"].sum().nunique() == 1


# -- kills ----------------------------------------------------------------------------------------

SCRIPT = """
import os, sys, time
from simenv_marl import evaluate
from tests.worlds.valued import POINTS, Shop, level, some

class Own(Shop):
    def reset(self, seed):
        super().reset(seed)
        with open(f"{store}.{os.getpid()}.log", "a") as log:
            log.write(f"{seed}\\n")

    def run(self):
        time.sleep(0.002 + 0.004 * workers)
        super().run()

store, workers, seeds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
order, sell = POINTS.values()
points = {Own.order: order, Own.sell: sell}

def run(seeds, store, workers=0):
    contenders = {"rule": {}, "some": {"keeper": some}}
    given = {"points": points, "metric": level, "store": store, "workers": workers}
    return evaluate(Own, contenders, seeds=range(seeds), **given).frame

if __name__ == "__main__":
    run(1, f"{store}.first")  # so that imports take no time of the others
    os.remove(f"{store}.{os.getpid()}.log")
    for _ in sys.stdin:
        process = os.fork()
        if not process:
            os.setsid()
            run(seeds, store, workers).to_pickle(f"{store}.table")
            os._exit(0)
        print(process, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""
"""Forks a process for each line of its input, and prints its id and its exit code."""


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL")
@pytest.mark.parametrize("workers", [0, 2])
def test_evaluate_store_survives_kills_without_losing_finished_episodes(workers, tmp_path):
    script, store = tmp_path / "script.py", tmp_path / "store"
    script.write_text(SCRIPT, encoding="utf-8")
    seeds = 60 * KILLS * (1 + workers)
    chance = random.Random(KILLS)
    path = os.pathsep.join([*filter(None, sys.path), str(ROOT)])

    def logs():
        return len([*tmp_path.glob("store.*.log")])

    def answer():
        return int(server.stdout.readline())

    def start():
        server.stdin.write(b"\n")
        server.stdin.flush()
        return answer()

    def end_group(number):
        with suppress(ProcessLookupError):
            os.killpg(number, signal.SIGKILL)

    kept, orphans = set(), []
    with subprocess.Popen(
        [sys.executable, script, store, str(workers), str(seeds)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
    ) as server:
        try:
            for _ in range(KILLS):
                before = logs()
                process = start()
                while orphans:  # workers of the last call have gone on beside this one
                    time.sleep(chance.uniform(0.0, 0.6))
                    end_group(orphans.pop())
                is_early = chance.random() < 0.2
                deadline = time.monotonic() + 30.0
                while not is_early and logs() == before and time.monotonic() < deadline:
                    time.sleep(0.001)
                time.sleep(chance.uniform(0.0, 0.2 + (0.6 if is_early else 0.1) * workers))
                os.kill(process, signal.SIGKILL)
                orphans.append(process)
                if not workers or chance.random() < 0.5:
                    end_group(orphans.pop())
                assert answer() == -signal.SIGKILL
                known = set(keys(store))
                assert kept <= known
                kept = known
            assert 0 < len(kept) < 2 * seeds
            start()
            assert answer() == 0
        finally:
            while orphans:
                end_group(orphans.pop())
            server.stdin.close()
    found = pd.read_pickle(f"{store}.table")
    contenders = {"rule": {}, "some": {"keeper": some}}
    given = {"seeds": range(seeds), "points": POINTS, "metric": level}
    assert found.equals(evaluate(Shop, contenders, **given).frame)
    assert set(keys(store)) == set(product(contenders, range(seeds)))
    if not workers:
        assert len(keys(store)) == len(set(keys(store)))
    for log in tmp_path.glob("store.*.log"):  # of a process
        begun = Counter(map(int, log.read_text().split()))
        paths = [*store.glob(f"runs-*{int(log.suffixes[-2][1:]):x}*.jsonl")]
        for path in paths:
            begun -= Counter(json.loads(line)["seed"] for line in whole_lines(path))
        # It has lost the episode that it was running alone. Processes may have had the same id.
        assert begun.total() <= len(paths)
