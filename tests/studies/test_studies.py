"""Each study runs from command line to figures, in small; ``tests/clients`` has the learners'."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from examples.greenhouse_coop import plan, train
from examples.greenhouse_coop.env import DAYS, GreenhouseSim
from examples.queue_admission.env import HORIZON
from examples.queue_admission.model import Queue
from studies.bases import measure as bases
from studies.debt_collection import model as agency
from studies.debt_collection import study as debts
from studies.debt_collection.env import CASES, NAMED_COLLECTOR, CollectionSim
from studies.demo import picture
from studies.event_planning import measure as events
from studies.event_planning import model as event_models
from studies.greenhouse_matrix import matrix, variants
from studies.greenhouse_plans import figures as plans
from studies.pension import study as pension
from studies.queue_network import study as network

from simenv_marl import simulate
from simenv_marl.testing import check_simulation


def big(path):
    return path.stat().st_size > 10_000


def short(kind):
    """A kind of greenhouses that are nearly at their end when they begin."""

    class Short(kind):
        def reset(self, seed=None):
            super().reset(seed)
            self.greenhouse.day = DAYS - 2

    return Short


def test_greenhouse_study_trains_plans_and_draws(tmp_path, capsys, monkeypatch):
    train.main(["--budget", "1", "--seeds", "2", "--workers", "1", "--out", str(tmp_path)])
    named = re.findall(
        r"^  (\S+/\S+)", capsys.readouterr().out.partition("What to do next:")[2], re.MULTILINE
    )
    assert len(named) == 4
    assert all((Path(__file__).parents[2] / path).is_file() for path in named)
    found = json.loads((tmp_path / "greenhouse.json").read_text())
    assert [len(values) for values in found["returns"].values()] == [2] * 6
    monkeypatch.setattr(plan, "GreenhouseSim", short(GreenhouseSim))
    plan.main(["--seeds", "1", "--futures", "1", "--out", str(tmp_path)])
    for name in picture.TITLES:
        picture.main([str(tmp_path / f"{name}.json")])
        assert big(tmp_path / f"{name}.png")


def test_greenhouse_matrix_study_writes_tables_and_pictures(tmp_path, capsys, monkeypatch):
    pytest.importorskip("seaborn")
    pytest.importorskip("statsmodels")
    monkeypatch.setattr(variants, "House", short(variants.House))
    table = matrix.main(["--quick", "--workers", "0", "--out", str(tmp_path)])
    assert set(table.status) == {"ok"}
    assert list(dict.fromkeys(table.contender)) == [
        "rule",
        "learned at home 1",
        "learned all over 1",
        "planned",
    ]
    assert all(big(tmp_path / f"matrix-{name}.png") for name in ("returns", "behind", "factors"))
    shown = capsys.readouterr().out
    for name in ("compared", "moved", "shares", "learners"):
        assert (tmp_path / f"matrix-{name}.md").read_text() in shown


def test_greenhouse_planning_study_draws_budgets_and_horizons(tmp_path, monkeypatch):
    monkeypatch.setattr(plan, "GreenhouseSim", short(GreenhouseSim))
    plans.main(["--seeds", "1", "--horizons", "1", "--futures", "1", "--figures", str(tmp_path)])
    assert big(tmp_path / "plan-budget.png")
    assert big(tmp_path / "plan-horizon.png")
    rows = (tmp_path / "plan.md").read_text().splitlines()[2:]
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows[:5]] == [
        line.title for line in plans.LINES
    ]


def test_credit_assignment_study_compares_estimators_with_the_truth(capsys):
    pytest.importorskip("mesa")
    from studies.credit import estimators

    found = estimators.main(["--decisions", "2", "--futures", "3", "--episodes", "3"])
    shown = capsys.readouterr().out
    returns, apart, paired, *others = next(iter(found.values()))
    assert apart.bias == paired.bias == 0
    assert paired.deviation < apart.deviation
    assert paired.days == 2 * returns.days
    assert all(way.title in shown for way in (returns, apart, paired, *others))


def test_base_policies_study_compares_substitutes_for_planning_agents(monkeypatch, capsys):
    monkeypatch.setattr("studies.bases.model.END", 15.0)
    monkeypatch.setattr("examples.greenhouse_coop.env.DAYS", 12)
    table = bases.main(["--quick"])
    shown = capsys.readouterr().out
    assert [row[0] for row in table] == list(bases.CASES)
    assert all(" ".join(row[:2]) in shown.replace(" | ", " ") for row in table)


def test_event_planning_study_compares_planning_with_the_models_rule(monkeypatch):
    monkeypatch.setattr(event_models, "JOBS", 3)
    rows = events.main(["--quick", "--horizon", "2"])
    settings = [(name, unit) for name in events.MODELS for unit in ("decision", "time")]
    assert [row.setting[::2] for row in rows] == settings
    assert all(0 <= row.share <= 1 and row.error >= 0 for row in rows)


def test_wolf_sheep_planning_study_lets_one_sheep_plan(capsys):
    pytest.importorskip("mesa")
    from studies.wolf_sheep import plan as sheep

    found = sheep.main(
        ["--herds", "2", "--horizon", "1", "--futures", "1", "--ticks", "3", "--workers", "1"]
    )
    assert found.own.shape == found.same.shape == (2,)
    assert "plans longer than by the rule" in capsys.readouterr().out


def test_pension_study_writes_tables_and_pictures(tmp_path, capsys):
    pytest.importorskip("seaborn")
    pension.main(["--quick", "--workers", "0", "--out", str(tmp_path)])
    shown = capsys.readouterr().out
    for name in ("compared", "worlds", "moved"):
        assert (tmp_path / f"pension-{name}.md").read_text() in shown
    assert all(big(tmp_path / f"pension-{name}.png") for name in ("worlds", "learned", "years"))


@pytest.mark.parametrize("points", [CASES, NAMED_COLLECTOR])
def test_check_simulation_finds_nothing_in_the_debt_collection_study(points):
    report = check_simulation(partial(CollectionSim, 30), points, episodes=2)
    assert not [finding for finding in report.findings if finding.severity != "note"], report


def test_debt_collection_study_learns_and_compares(capsys):
    agency.main(["--days", "60"])
    assert "profit, dollars" in capsys.readouterr().out
    debts.main(["--generations", "1", "--seeds", "2", "--days", "60"])
    shown = capsys.readouterr().out
    assert "Thresholds(" in shown
    assert all(name in shown for name in ("learned", "rule", *debts.CONSTANTS))
    # of what it has learned from
    third = CollectionSim(parameters=agency.Parameters(arrivals=0.3, stock=20, calls=1))
    unseen = range(debts.HELD_OUT, debts.HELD_OUT + 32)
    result = debts.compare({"learned": debts.LEARNED}, unseen, third).summary().loc["learned"]
    assert result["difference"] > result["difference_low"] > 0


def test_docs_pages_state_the_figures_of_the_finished_studies():
    """The table of the greenhouse experiment agrees with the runs under version control."""
    pytest.importorskip("pandas")
    import pandas as pd
    from studies.greenhouse_experiment import results

    finals = pd.read_csv(results.DATA / "finals.csv", dtype={"library": str, "question": str})
    assert results.table(finals) == (results.FIGURES / "experiment.md").read_text()


def test_queue_network_study_compares_two_learners_with_their_rules(capsys):
    network.main(["--episodes", "150", "--trainings", "1", "--runs", "20"])
    shown = capsys.readouterr().out
    assert shown.count("both learned") == 3
    alone = Queue(np.random.SeedSequence(3).generate_state(2).tolist()[0])
    alone.clock.run(until=HORIZON)
    both = simulate(network.NetworkSimulation, seed=3).model
    # what comes after it does not change it
    assert both.first.present_value() == alone.present_value()
    first = network.train(150)["first"].table()
    assert network.worth(first) > 1.1 * network.worth(network.ADMIT_ALL)
