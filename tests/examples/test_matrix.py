"""The paper's matrix: the rows are what they say, and the script runs, resumes, and shows what it has found."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from examples.greenhouse_coop import matrix, plan, variants
from examples.greenhouse_coop.env import DAYS, MOST_WATER

from simenv_marl import simulate

CONTENDERS = ["rule", "learned at home 1", "learned all over 1", "planned"]


class Short(variants.House):
    """A greenhouse that is nearly at its end when it begins."""

    def reset(self, seed=None):
        super().reset(seed)
        self.greenhouse.day = DAYS - 4


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(variants, "House", Short)


def quick(tmp_path):
    return matrix.main(["--quick", "--workers", "0", "--out", str(tmp_path)])


# -- rows -----------------------------------------------------------------------------------------


def house(*row, water=0.05):
    """A greenhouse of a row that is watered by the same amount each day, and its observations."""
    seen = []

    def waterer(observation):
        seen.append(observation)
        return [water]

    simulation = simulate(variants.greenhouse(*row), {"waterer_0": waterer}, seed=5)
    return simulation.greenhouse, np.array(seen)


def state(greenhouse):
    return greenhouse.water_use, greenhouse.humidity, [(plant.water, plant.health) for plant in greenhouse.pots]


def test_home_is_the_greenhouse_of_the_paper():
    home = state(simulate(variants.greenhouse(**matrix.HOME), seed=5).greenhouse)
    assert home == state(simulate(variants.BASE, seed=5).greenhouse)
    warm = state(simulate(variants.greenhouse(200, "mild", "warm"), seed=5).greenhouse)
    assert warm == state(simulate(variants.WARM_EXCHANGE, seed=5).greenhouse) != home


@pytest.mark.parametrize("plants", matrix.FACTORS["plants"])
def test_any_number_of_plants_of_which_the_first_are_the_models_own(plants):
    greenhouse, _ = house(plants, "mild", "fixed")
    thirst = [plant.req_water for plant in greenhouse.pots]
    assert len(thirst) == plants
    assert thirst[:200] == [plant.req_water for plant in simulate(variants.BASE, seed=5).greenhouse.pots][:plants]


def test_climates_and_exchanges_are_what_they_are_called():
    home, decided, dry, erratic = (
        house(100, *row)[1] for row in (("mild", "fixed"), ("mild", "decided"), ("dry", "fixed"), ("erratic", "fixed"))
    )
    assert decided[:, 1].mean() < home[:, 1].mean()  # the humidity
    assert dry[:, 1].mean() < home[:, 1].mean()
    change = [np.abs(np.diff(own[:, 0])).max() * 20 for own in (home, erratic)]  # of the temperature
    assert change[0] <= 2.01
    assert change[1] > 10


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("plants", [100, 400])
def test_the_planner_pours_portions_for_each_pot(plants):
    poured = []

    class Watched(plan.PortionPlanner):
        def __call__(self, observation, info, *, _environment):
            action = super().__call__(observation, info, _environment=_environment)
            poured.append(float(action[0]) * MOST_WATER / plants)
            return action

    simulate(variants.greenhouse(plants, "mild", "fixed"), {"waterer_0": Watched()}, seed=5)
    assert len(poured) == 4
    assert all(min(abs(portion - own) for own in plan.PORTIONS) < 1e-6 for portion in poured)


@pytest.mark.parametrize("plants", [100, 400])
def test_what_is_still_to_come_counts_shares_of_the_plants_that_there_are(plants):
    simulation = variants.House(plants)
    simulation.reset(1)
    simulation.greenhouse.day = 60
    env = SimpleNamespace(unwrapped=SimpleNamespace(simulation=simulation))
    assert (plan.days_left(env), plan.share_alive(env)) == (40, 1)


# -- the script -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("short")
def test_it_runs_what_is_missing_and_nothing_else(tmp_path, monkeypatch):
    levels = {"plants": [100, 200], "climate": ["mild"], "exchange": ["decided"]}
    waterers = {**matrix.learned(tmp_path, 1, 1, 0), "planned": plan.PortionPlanner()}
    table = matrix.run(tmp_path / "runs", levels, waterers, 2, 0)
    assert list(table.columns) == [
        *levels, "contender", "seed", "agent", "return", "length", "alive", "litres", "status", "error",
    ]  # fmt: skip
    assert len(table[table.agent == "team"]) == 2 * len(CONTENDERS) * 2
    assert list(dict.fromkeys(table.contender)) == CONTENDERS
    assert set(table.status) == {"ok"}

    monkeypatch.setattr(matrix, "train", None)  # nothing is trained again
    [lines] = (tmp_path / "runs").glob("*.jsonl")
    known = lines.read_text().splitlines(keepends=True)
    assert len(known) == 2 * len(CONTENDERS) * 2
    lines.write_text("".join(known[:-5]))
    again = {**matrix.learned(tmp_path, 1, 1, 0), "planned": plan.PortionPlanner()}
    assert matrix.run(tmp_path / "runs", levels, again, 2, 0).equals(table)
    added = [own.read_text().splitlines() for own in (tmp_path / "runs").glob("*.jsonl") if own != lines]
    assert sorted(run_of(line) for own in added for line in own) == sorted(map(run_of, known[-5:]))


def run_of(line):
    known = json.loads(line)
    return known["factors"]["plants"], known["factors"]["exchange"], known["contender"], known["seed"]


@pytest.mark.usefixtures("short")
def test_from_one_end_to_the_other(tmp_path, capsys):
    pytest.importorskip("seaborn")
    pytest.importorskip("statsmodels")
    table = quick(tmp_path)
    assert len(table[table.agent == "team"]) == 8 * len(CONTENDERS) * 2
    for name in ("returns", "behind", "factors"):
        assert (tmp_path / f"matrix-{name}.png").stat().st_size > 10_000
    shown = capsys.readouterr().out
    for name in ("compared", "moved", "shares", "learners"):
        assert (tmp_path / f"matrix-{name}.md").read_text() in shown
    compared = (tmp_path / "matrix-compared.md").read_text().splitlines()
    assert len(compared) == 2 + 2 * len(CONTENDERS)
    assert quick(tmp_path).equals(table)
