"""Every row of a design, every contender, every seed: stored as it is run, and resumed."""

import asyncio
import errno
import json
import math
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from functools import partial
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
import pytest

from simenv_marl import evaluate
from simenv_marl.errors import AgentError, OptionValueError, StoreError, UnknownPointError
from simenv_marl.experiments import Variant, run_experiment
from simenv_marl.plugins import ChangedResult
from simenv_marl.remote import ProcessSimulation
from tests.outside.reservoirs import BOTH, command
from tests.worlds.entities import Being, beings
from tests.worlds.models import Script
from tests.worlds.valued import POINTS, Shop, level, much, much_of_many, some, some_of_many

DESIGN = pd.DataFrame(
    {"days": [1, 3, 2], "price": [0.5, 1.0, 2.0], "kind": ["plain", "faulty", "plain"]}
)
ROOT = Path(__file__).parents[2]


def run(store, design=DESIGN, make=Shop, **arguments):
    contenders = {"much": {"keeper": much}, "some": {"keeper": some}}
    given = {
        "contenders": contenders,
        "seeds": range(4),
        "points": POINTS,
        "metric": {"level": level},
        **arguments,
    }
    return run_experiment(make, design, store=store, **given)


def lines(store):
    whole = (line for path in store.glob("*.jsonl") for line in path.read_bytes().split(b"\n")[:-1])
    return [json.loads(line) for line in whole]


def test_run_experiment_returns_a_tidy_table_and_stores_provenance(tmp_path):
    frame, known = run(tmp_path), lines(tmp_path)
    factors, outcome = ["days", "price", "kind"], ["status", "error"]
    assert list(frame.columns) == [
        *factors,
        "contender",
        "seed",
        "agent",
        "return",
        "length",
        "level",
        *outcome,
    ]
    assert frame[factors].dtypes.equals(DESIGN.dtypes)
    runs = frame[frame.agent == "team"]
    contenders = {"rule": {}, "much": {"keeper": much}, "some": {"keeper": some}}
    expected = [
        [*row, name, seed]
        for row in DESIGN.values.tolist()
        for name in contenders
        for seed in range(4)
    ]
    assert runs[[*factors, "contender", "seed"]].values.tolist() == expected
    failed = runs[runs.status == "error"]
    assert set(zip(failed["kind"], failed["seed"], strict=True)) == {("faulty", 1), ("faulty", 3)}
    assert set(failed["error"]) == {"ZeroDivisionError: no change"}
    assert failed["return"].isna().all()
    good = frame[(frame["kind"] == "plain") & (frame["days"] == 2)].drop(
        columns=[*factors, *outcome]
    )
    given = {"seeds": range(4), "points": POINTS, "metric": {"level": level}}
    assert good.reset_index(drop=True).equals(
        evaluate(lambda: Shop(2, 2.0), contenders, **given).frame
    )
    assert len(known) == 3 * 3 * 4
    assert {(line["status"], line["error"]) for line in known} == {
        ("ok", None),
        ("error", *set(failed["error"])),
    }
    (line,) = (
        e for e in known if (e["contender"], e["seed"], e["factors"]["days"]) == ("some", 2, 1)
    )
    provenance = line["provenance"]
    assert provenance["seed"] == 2
    assert provenance["simulation"] == "tests.worlds.valued.Shop"
    assert provenance["policies"] == {"keeper": "tests.worlds.valued.some"}
    assert "numpy" in provenance["dependencies"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "arguments",
    [
        *({"workers": workers} for workers in (1, 2)),
        *({"batched": True, **more} for more in ({}, {"workers": 2}, {"batch_size": 2})),
    ],
    ids=str,
)
def test_run_experiment_table_is_the_same_with_workers_and_batches(arguments, tmp_path, capsys):
    if arguments.get("batched"):
        arguments = {
            "contenders": {"much": {"keeper": much_of_many}, "some": {"keeper": some_of_many}},
            **arguments,
        }
    alone, store = run(tmp_path / "alone"), tmp_path / "shared"
    assert run(store, progress=True, **arguments).equals(alone)
    assert "36/36" in capsys.readouterr().err
    assert len({path.name.split("-")[2] for path in store.glob("*.jsonl")}) <= arguments.get(
        "workers", 1
    )
    run(store, progress=True, seeds=range(5), **arguments)
    assert "45/45" in capsys.readouterr().err


@pytest.mark.parametrize(
    "make",
    [
        lambda days, price, kind: Shop(days, price, kind),
        lambda days, price, kind: Variant(
            "v", Shop, parameters={"days": days, "price": price, "kind": kind}
        ),
        lambda days, price, kind: lambda: Shop(days, price, kind),
        lambda **row: type("Sub", (Shop,), {"__init__": lambda self: Shop.__init__(self, **row)}),
        Variant("v", Shop),
    ],
)
def test_run_experiment_takes_classes_factories_and_variants(make, tmp_path):
    assert run(tmp_path / "a", make=make).equals(run(tmp_path / "b"))


@pytest.mark.parametrize(
    "arguments", [{}, {"batched": True}, {"batched": True, "batch_size": 2}], ids=str
)
@pytest.mark.parametrize("error", [SystemExit, asyncio.CancelledError, MemoryError])
@pytest.mark.parametrize("method", ["run", "close"])
def test_run_experiment_turns_exits_and_errors_into_error_rows(method, error, arguments, tmp_path):
    def end(shop):
        getattr(Shop, method, lambda shop: None)(shop)
        if shop.seed == 1:
            raise error("enough")

    ending = type("Ending", (Shop,), {method: end})
    frame = run(tmp_path, {"days": [1]}, make=ending, contenders=None, **arguments)
    assert frame["status"].tolist() == ["ok"] * 3 + ["error"] + ["ok"] * 6
    assert frame["error"][3] == f"{error.__name__}: enough"
    assert len(lines(tmp_path)) == 4


@pytest.mark.parametrize("batched", [False, True])
def test_run_experiment_ends_at_a_keyboard_interrupt(batched, tmp_path):
    class Interrupted(Shop):
        def run(self):
            if self.seed == 2:
                raise KeyboardInterrupt
            super().run()

    with pytest.raises(KeyboardInterrupt):
        run(
            tmp_path,
            {"days": [1]},
            make=Interrupted,
            contenders=None,
            batched=batched,
            batch_size=1,
        )
    assert [line["seed"] for line in lines(tmp_path)] == [0, 1]


def test_run_experiment_takes_iterators_of_points_and_plugins(tmp_path):
    class Own(Shop):
        points = POINTS

    plugins = [
        (lambda shop, _result: ChangedResult(2 * _result), "tests.worlds.valued.Shop.sell", "after")
    ]
    points, given = [Shop.order], {"make": Own, "contenders": {"much": {"keeper": much}}}
    expected = run(tmp_path / "a", points=points, plugins=plugins, **given)
    assert run(tmp_path / "b", points=iter(points), plugins=iter(plugins), **given).equals(expected)


def test_run_experiment_does_not_repeat_stored_runs(tmp_path):
    calls = []

    def make(days):
        calls.append(days)
        return Shop(days)

    def again(days, seeds=range(3), contenders=None, **options):
        calls.clear()
        return run(
            tmp_path, {"days": days}, make=make, seeds=seeds, contenders=contenders, **options
        )

    first = again([1, 2])
    assert again([1, 2]).equals(first)
    assert len(calls) <= 1  # it is looked at
    assert again([1, 2], range(2)).equals(first[first.seed < 2].reset_index(drop=True))
    twice = again([1, 2, 1, 2])
    assert all(
        half.reset_index(drop=True).equals(first)
        for half in (twice[: len(first)], twice[len(first) :])
    )
    failed = again([1, 2, 3], team=lambda returns: returns["stranger"])
    assert set(failed["agent"]) == {"team"}
    assert set(failed["status"]) == {"error"}
    assert (
        "'stranger' did not decide in this episode; these did: keeper, helper" in failed["error"][0]
    )
    assert len(lines(tmp_path)) == 3 * 3
    # it is mended
    assert set(again([1, 2, 3, 1], team=lambda returns: returns.pop("keeper"))["status"]) == {"ok"}
    assert len(lines(tmp_path)) == 3 * 3
    again([3, 1, 2], range(4), {"much": {"keeper": much}})
    assert len(lines(tmp_path)) == 3 * 4 * 2
    with pytest.warns(UserWarning, match="1 rows that this design does not have"):
        assert again([1, 2]).equals(first)


@pytest.mark.parametrize(
    "damage",
    [
        *(b"[" * 100_000, b"\xff\xfe{}", b"{}", b"[]", b"1" * 5000),
        *({"provenance": own} for own in ({"options": "none"}, [1])),
        {"status": "ok", "metrics": None, "provenance": None},
    ],
)
def test_run_experiment_repeats_the_run_of_a_damaged_line(damage, tmp_path):
    def again():
        return run(tmp_path, {"days": [1]}, seeds=range(2), contenders=None)

    first = again()
    (path,) = tmp_path.glob("*.jsonl")
    one, other = path.read_bytes().splitlines()
    damaged = damage if isinstance(damage, bytes) else json.dumps(json.loads(one) | damage).encode()
    path.write_bytes(damaged + b"\n" + other + b"\n")
    with pytest.warns(
        UserWarning, match="line 1 of .* cannot be read, so its run counts as missing"
    ):
        assert again().equals(first)


def test_run_experiment_repeats_failed_runs_on_request(tmp_path):
    attempt = 0

    def make(days):
        if attempt < 4:
            raise OSError(f"attempt {attempt}")
        return Shop(days)

    def again(**arguments):
        return run(tmp_path, {"days": [1]}, make=make, seeds=[1], contenders=None, **arguments)

    for attempt in range(4):
        assert again(retry_errors=True)["error"].tolist() == [f"OSError: attempt {attempt}"]
    attempt = 4
    assert again()["error"].tolist() == ["OSError: attempt 3"]
    assert again(retry_errors=True)["status"].tolist() == ["ok"] * 3
    assert again()["status"].tolist() == ["ok"] * 3


def test_run_experiment_store_keeps_types_of_factors_and_metrics(tmp_path):
    things = [1, 1.0, True, "1", "\u00e9\n", None, math.inf, -0.0, 0.1, 2**70]
    design = pd.DataFrame({"kind": pd.Series(things, dtype=object)})
    frame = run(tmp_path, design, contenders=None, seeds=[0], metric=lambda shop: shop.kind)
    told = frame[frame.agent == "team"]
    for column in ("kind", "metric"):
        assert list(map(repr, told[column])) == list(map(repr, things))


@pytest.mark.parametrize(
    ("match", "arguments"),
    [
        ("cannot be called with the factors", {"make": lambda days: Shop(days)}),
        ("must be a callable of the factors", {"make": Shop()}),
        ("cannot be called with the parameters", {"make": Variant("v", lambda days: Shop(days))}),
        ("factor 'seed' has the name of", {"design": {"seed": [1]}}),
        ("factor 'error' has the name of", {"design": {"error": [1]}}),
        ("metric 'days' has the name of", {"metric": {"days": level}}),
        ("has no rows", {"design": DESIGN[:0]}),
        ("must be a string", {"design": pd.DataFrame([[1]])}),
        ("factor 'days' must be a number", {"design": {"days": [object()]}}),
        ("cannot be stored as JSON", {"design": {"days": [10**5000]}}),
        ("must be a DataFrame", {"design": 3}),
        ("'rule' is always the model as it is", {"contenders": {"rule": {"keeper": much}}}),
        ("unknown|no option", {"nonsense": 3}),
        ("no option policies here; .* in contenders=", {"policies": {"a": {"keeper": much}}}),
        ("team", {"team": 3}),
    ],
)
def test_run_experiment_refuses_invalid_arguments_before_it_stores(match, arguments, tmp_path):
    with pytest.raises((OptionValueError, UnknownPointError, TypeError), match=match):
        run(tmp_path / "store", **arguments)
    assert not (tmp_path / "store").exists()


def test_run_experiment_refuses_the_store_of_another_experiment(tmp_path):
    run(tmp_path)
    for match, arguments in (
        ("its factors are", {"design": DESIGN[["days"]]}),
        ("its metrics are", {"metric": None}),
        ("but this design has none", {"design": DESIGN.assign(days=7)}),
        (r'"days":1,.*its first is {"days":1.0,', {"design": DESIGN.astype({"days": float})}),
    ):
        with pytest.raises(OptionValueError, match=match):
            run(tmp_path, **arguments)
    other = tmp_path / "other"
    other.mkdir()
    for name in (".hidden", "experiment.json.0123", "thesis.tex"):
        (other / name).write_text("")
    with pytest.raises(OptionValueError, match="not the store of an experiment"):
        run(other)
    (other / "thesis.tex").unlink()
    assert len(run(other)) > 0
    (other / "experiment.json").write_text('{"simenv_marl": 1}')
    with pytest.raises(OptionValueError, match="its factors are None"):
        run(other)


def test_run_experiment_joins_a_store_that_another_process_makes(tmp_path, monkeypatch):
    real = Path.iterdir

    def iterdir(path):
        with monkeypatch.context() as patch:
            patch.setattr(Path, "iterdir", real)
            run(tmp_path)
        return real(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert run(tmp_path).equals(run(tmp_path))
    assert len(lines(tmp_path)) == 36


@pytest.mark.parametrize(
    ("told", "arguments"),
    [
        (r'options {} then, {"max_steps": 2} now', {"max_steps": 2}),
        (
            r"'much' .*policies .*valued.much.* then, .*valued.some",
            {"contenders": {"much": {"keeper": some}}},
        ),
        (r"simulation .*Shop.* then, .*Other.* now", {"make": type("Other", (Shop,), {})}),
        (
            r"plugins \[\] then",
            {"plugins": [(lambda shop: None, "tests.worlds.valued.Shop.sell", "before")]},
        ),
        (r"points .*helper.* then", {"points": {Shop.order: POINTS[Shop.order]}}),
    ],
)
def test_run_experiment_warns_if_stored_runs_had_other_definitions(told, arguments, tmp_path):
    contenders = {"contenders": {"much": {"keeper": much}}}
    first = run(tmp_path, **contenders)
    more = pd.concat([DESIGN[:1].assign(days=7), DESIGN])  # of whose first row nothing is stored
    for design in (DESIGN, more):
        with pytest.warns(UserWarning, match=told):
            frame = run(tmp_path, design, **contenders | arguments)
        assert frame[frame["days"] != 7].reset_index(drop=True).equals(first)


def test_run_experiment_continues_despite_a_stored_failed_run(tmp_path):
    def make(days):
        return Variant("v", Shop, parameters={"days": days} if days != 2 else {"nights": days})

    frame = run(tmp_path, {"days": [1, 2]}, make=make, contenders=None)
    assert set(frame[frame["days"] == 2]["status"]) == {"error"}
    with pytest.warns(UserWarning, match="rows that this design does not have"):
        frame = run(tmp_path, {"days": [3, 2]}, make=make, contenders=None)
    assert frame.groupby("days")["status"].first().to_dict() == {2: "error", 3: "ok"}


def test_run_experiment_does_not_warn_if_stored_definitions_are_equal(tmp_path):
    class Policy:
        def __call__(self, observation):
            return 1

    first = run(tmp_path, contenders={"a": {"keeper": Policy()}}, driver="thread", workers=2)
    kept = [Policy() for _ in range(3)]
    turned = dict(reversed(POINTS.items()))
    assert run(
        tmp_path, contenders={"a": {"keeper": kept[-1]}}, points=turned, driver="greenlet"
    ).equals(first)


def test_run_experiment_warns_of_another_version_of_a_package(tmp_path):
    first = run(tmp_path)
    (path,) = tmp_path.glob("*.jsonl")
    path.write_bytes(
        path.read_bytes().replace(f'"numpy":"{np.__version__}"'.encode(), b'"numpy":"1.0"')
    )
    with pytest.warns(UserWarning, match=f"numpy 1.0 then, {np.__version__} now"):
        assert run(tmp_path).equals(first)


@pytest.mark.parametrize(("batched", "cut"), [(False, 1), (True, 20), (True, 700)])
def test_run_experiment_repeats_only_the_torn_run_after_a_full_disk(
    batched, cut, tmp_path, monkeypatch
):
    def open_full(path, *args, **kwargs):
        def write(data):
            written.extend([data] if data else [])
            if len(written) <= 5:
                return real_write(data)
            real_write(data[:-cut])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        file = real(path, *args, **kwargs)
        if path.suffix == ".jsonl":
            real_write, file.write = file.write, write
        return file

    real, written = Path.open, []
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", open_full)
        with pytest.raises(StoreError, match="No space left"):
            run(tmp_path / "full", contenders=None, batched=batched)
    assert len(lines(tmp_path / "full")) == 5
    assert run(tmp_path / "full", contenders=None).equals(run(tmp_path / "whole", contenders=None))


def test_run_experiment_raises_an_error_for_an_unusable_store(tmp_path):
    (tmp_path / "file").write_text("")
    for store in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(
            StoreError, match="cannot be made or read as the folder of an experiment"
        ):
            run(store)
    for text in (b"[" * 100_000, b"\xff\xfe[", b"{"):
        (tmp_path / "experiment.json").write_bytes(text)
        with pytest.raises(StoreError, match=r"experiment\.json cannot be read"):
            run(tmp_path)
    with pytest.raises(TypeError, match="NoneType"):
        run(None)


def test_run_experiment_store_is_relative_to_the_users_directory(tmp_path, monkeypatch):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)  # where workers that were started before are not
        run("new/store", DESIGN[:1], workers=2)
        assert len(lines(tmp_path / name / "new" / "store")) == 12


def test_run_experiment_threads_write_files_of_their_own(tmp_path):
    with joblib.parallel_config(backend="threading"):
        frame = run(
            tmp_path / "shared", workers=2, make=lambda **row: Shop(**row | {"kind": "slow"})
        )
    assert frame["status"].tolist() == ["ok"] * len(frame)
    assert len(list((tmp_path / "shared").glob("*.jsonl"))) == 2


def visits(days=2):
    """Two beings decide each day, and a late one on the fifth day alone, and not with seed 0."""

    def main(simulation):
        simulation.beings = list(map(Being, range(5)))
        for day in range(days):
            for number in (0, 1, *((4,) if day == 4 and simulation.seed else ())):
                simulation.beings[number].act()

    return Script(main)


@pytest.mark.filterwarnings("ignore:policies= or possible_agents= name agents")
@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True}], ids=str)
def test_run_experiment_reports_a_misnamed_agent_for_its_contender(arguments, tmp_path):
    policy = much_of_many if arguments.get("batched") else much
    given = {"seeds": range(3), "points": beings(), **arguments}
    told = (
        "'wrong' has a policy for 'beeing_1', but no agent "
        ".*decided: being_0, being_1; did you mean being_1"
    )
    contenders = {"right": {"being_1": policy}, "wrong": {"being_1": policy, "beeing_1": policy}}
    with pytest.raises(AgentError, match=told):
        evaluate(visits, contenders, **given)
    design = {"days": [2, 5]}
    with pytest.raises(AgentError, match=told):
        run_experiment(visits, design, contenders=contenders, store=tmp_path, **given)
    assert "wrong" not in {line["contender"] for line in lines(tmp_path)}
    contenders = {"right": {"being_1": policy}, "late": {"being_4": policy}}
    # it may come later, or not at all
    named = {"contenders": contenders, "possible_agents": ["being_4"], **given}
    evaluate(visits, **named)
    assert set(run_experiment(visits, design, store=tmp_path / "named", **named)["status"]) == {
        "ok"
    }
    contenders = {"late": {"being_4": policy}}  # stored as soon as it is there
    frame = run_experiment(
        visits, {"days": [5]}, contenders=contenders, store=tmp_path / "late", **given
    )
    assert frame[frame["agent"] == "being_4"]["length"].tolist() == [1] * 4


@pytest.mark.parametrize("arguments", [{}, {"workers": 2}, {"batched": True}], ids=str)
def test_run_experiment_keeps_definitions_of_each_row_separate(arguments, tmp_path):
    def make(scale):
        """Return the same object for all rows, whose points are replaced."""
        for point, definition in POINTS.items():
            one.points[point] = replace(definition, reward_mapping=lambda shop: float(scale))
        return one

    one, given = Shop(), {"seeds": [1, 2], "metric": level}
    one.points = {}
    frame = run_experiment(make, {"scale": [1, 10]}, store=tmp_path, **given, **arguments)
    assert frame["return"].tolist() == [3, 3, 6] * 2 + [30, 30, 60] * 2
    alone = evaluate(Shop, {"rule": {}}, points=POINTS, **given).frame["metric"].tolist()
    assert frame["metric"].tolist() == 2 * alone


def test_run_experiment_reuses_a_simulators_process_only_in_its_directory(tmp_path, monkeypatch):
    def make(name, folder):
        (tmp_path / folder).mkdir(exist_ok=True)
        monkeypatch.setenv("HARBOUR", name)
        monkeypatch.chdir(tmp_path / folder)
        return ProcessSimulation(["sh", "-c", telling, "sh", *command()], BOTH)

    telling = f'echo "$HARBOUR $PWD" >> {tmp_path / "started"}; exec "$@"'
    rows = {"name": ["a", "b", "b"], "folder": ["c", "c", "d"]}
    run_experiment(make, rows, seeds=[1, 2], store=tmp_path / "store")
    started = (tmp_path / "started").read_text().splitlines()
    assert started == [f"{name} {tmp_path / folder}" for name, folder in ("ac", "bc", "bd")]


class Deadly(Shop):
    def run(self):
        if self.days == 2 and self.seed == 1:
            os._exit(3)
        super().run()


@pytest.mark.thorough
@pytest.mark.parametrize("batched", [False, True])
def test_run_experiment_turns_a_dead_workers_run_into_an_error_row(batched, tmp_path):
    given = {"design": {"days": [1, 2, 3]}, "contenders": None, "batched": batched}
    frame = run(tmp_path / "a", make=Deadly, workers=2, **given)
    whole = run(tmp_path / "b", **given)
    failed = frame["status"] == "error"
    assert frame.loc[failed, ["days", "seed"]].to_numpy().tolist() == [[2, 1]]
    assert "worker died in this run, twice" in frame.loc[failed, "error"].item()
    at = (whole["days"] == 2) & (whole["seed"] == 1)
    assert frame.loc[~failed, "return"].tolist() == whole.loc[~at, "return"].tolist()
    assert run(tmp_path / "a", make=Deadly, workers=2, **given).equals(frame)


def test_run_experiment_refuses_backends_that_hide_dead_workers(
    tmp_path,
):
    with joblib.parallel_config(backend="multiprocessing"):
        with pytest.raises(OptionValueError, match="joblib"):
            evaluate(Shop, {"rule": {}}, seeds=[1], points=POINTS, workers=2)
        with pytest.raises(OptionValueError, match="joblib"):
            run(tmp_path / "store", workers=2)
    assert not (tmp_path / "store").exists()


def test_run_experiment_marks_integers_too_long_for_json_as_errors(tmp_path):
    frame = run(tmp_path / "metric", {"days": [1]}, metric=lambda shop: 10**5000)
    assert frame["error"].str.contains("cannot be stored as JSON").all()
    with pytest.raises(OptionValueError, match="cannot be stored as JSON"):
        run(tmp_path / "policy", contenders={"a": {"keeper": partial(much, number=10**5000)}})


SCRIPT = """
    import os, signal, sys
    from pathlib import Path
    sys.path.insert(0, sys.argv[1])
    import pandas as pd
    from simenv_marl.experiments import run_experiment
    from tests.worlds.valued import POINTS, Shop, level, some

    class Own(Shop):
        def order(self):
            return 3

        def run(self):
            files = Path(store).glob("*.jsonl")
            if most and sum(path.read_bytes().count(b"\\n") for path in files) >= most:
                os.killpg(0, signal.SIGKILL)
            super().run()

    store, workers, most = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    if __name__ == "__main__":
        undecided = run_experiment(
            Own, {"days": [1]}, seeds=[1], store=f"{store}.undecided", workers=workers,
            metric=lambda shop: shop.days,
        )
        columns = ["agent", "return", "length", "metric"]
        assert undecided[columns].values.tolist() == [["team", 0.0, 0, 1]]
        order, sell = POINTS.values()
        kinds = ["plain"] * 5 + ["faulty"]
        design = pd.DataFrame({"days": range(1, 7), "price": 0.5, "kind": kinds})
        frame = run_experiment(
            Own, design, contenders={"some": {Own.order: some}}, seeds=range(4),
            points={Own.order: order, Shop.sell: sell}, metric=level, store=store,
            workers=workers,
        )
        frame.to_pickle(f"{store}.table")
"""
"""Workers find what a script defines, and a model need not decide."""


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no SIGKILL")
@pytest.mark.parametrize("workers", [0, 2])
def test_run_experiment_killed_loses_only_the_runs_in_progress(workers, tmp_path):
    script, store = tmp_path / "script.py", tmp_path / "store"
    script.write_text(textwrap.dedent(SCRIPT), encoding="utf-8")

    def start(folder, number, most):
        command = [
            sys.executable,
            "-W",
            "error::UserWarning",
            script,
            ROOT,
            folder,
            str(number),
            str(most),
        ]
        return subprocess.run(
            command, start_new_session=True, stderr=subprocess.PIPE, text=True, check=False
        )

    for most in (1, 20):
        assert start(store, workers, most).returncode == -signal.SIGKILL
        assert len(lines(store)) >= most
    for folder, number in ((store, workers), (tmp_path / "undisturbed", 0)):
        done = start(folder, number, 0)
        assert done.returncode == 0, done.stderr
    tables = [pd.read_pickle(tmp_path / f"{name}.table") for name in ("store", "undisturbed")]
    assert tables[0].equals(tables[1])
    keys = [
        (json.dumps(entry["factors"]), entry["contender"], entry["seed"]) for entry in lines(store)
    ]
    assert len(set(keys)) == 6 * 2 * 4
    if not workers:
        assert len(keys) == len(set(keys))
