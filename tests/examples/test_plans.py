"""Plans of the greenhouse and of a sheep, and credit by branches: everything that is shown, in a small way."""

from types import SimpleNamespace

import pytest
from examples.greenhouse_coop import plan, plan_figures
from examples.greenhouse_coop.env import DAYS, GreenhouseSim
from examples.greenhouse_coop.train import play, raw_env

from simenv_marl import RULE
from simenv_marl.data import collect_episodes


class Short(GreenhouseSim):
    """A greenhouse that is nearly at its end when it begins."""

    def reset(self, seed=None):
        super().reset(seed)
        self.greenhouse.day = DAYS - 4


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(plan, "GreenhouseSim", Short)


def test_greenhouses_that_are_kept_are_those_of_the_demo():
    kept = plan.keep(plan.BEST, [plan.HELD_OUT, plan.HELD_OUT + 1])
    environment = raw_env()
    team = {agent: lambda observation, space, own=own: own(observation) for agent, own in plan.BEST.items()}
    for number in range(2):
        outcome = play(environment, team, plan.HELD_OUT + number)
        assert kept.returns[number] == pytest.approx(outcome.value)
        assert kept.alive[number].round().tolist() == outcome.alive
        assert kept.poured[number] == pytest.approx(outcome.poured)
    by_rule = plan.keep({}, [1])
    assert by_rule.poured.sum() == 1800
    assert by_rule.alive[0, -1] == by_rule.simulated == 0


def test_all_days_in_branches_are_counted():
    """Nine amounts are tried out once, then five, then three, then two again in what is left of two times nine."""
    team = {"waterer_0": plan.water_planner(RULE, 3, 2), "ventilator_0": RULE}
    extras = collect_episodes(Short, team, seeds=[1])["waterer_0"].extras["days"]
    branches = 9 + 5 + 3
    assert extras.tolist() == [branches * days for days in (3, 3, 2, 1)]


def test_a_planner_pours_what_saves_the_plants(short):
    planned = plan.keep({"waterer_0": plan.water_planner(RULE, 2, 1)}, [1, 2])
    assert planned.simulated == 9 * (2 + 2 + 2 + 1)
    assert planned.poured.sum() < plan.keep({}, [1, 2]).poured.sum()


def test_both_may_plan(short):
    kept = plan.keep(plan_figures.both(1, 1), [1])
    assert kept.simulated == (9 + 5) * 4


def test_what_comes_after_the_horizon():
    simulation = GreenhouseSim()
    simulation.reset(1)
    for plant in simulation.greenhouse.pots[:50]:
        plant.health = 0.0
    simulation.greenhouse.day = 60
    env = SimpleNamespace(unwrapped=SimpleNamespace(simulation=simulation))
    assert plan.share_alive(env) == 0.75
    assert plan.days_left(env) == 30


@pytest.mark.usefixtures("short")
def test_the_table_and_the_picture(tmp_path, capsys):
    kept = plan.main(["--seeds", "1", "--futures", "1", "--out", str(tmp_path)])
    assert (tmp_path / "plan.png").stat().st_size > 10_000
    shown = capsys.readouterr().out
    for title, own in kept.items():
        assert title in shown.replace("\n", " ") or f"{own.returns.mean():.1f}" in shown


@pytest.mark.usefixtures("short")
def test_the_pictures_of_budgets_and_horizons(tmp_path):
    plan_figures.main(["--seeds", "1", "--horizons", "1", "--futures", "1", "--figures", str(tmp_path)])
    for name in ("budget", "horizon"):
        assert (tmp_path / f"plan-{name}.png").stat().st_size > 10_000
    rows = (tmp_path / "plan.md").read_text().splitlines()[2:]
    assert len(rows) == len(plan_figures.LINES) + 2
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows[:5]] == [line.title for line in plan_figures.LINES]


# -- sheep, and credit ----------------------------------------------------------------------------


def test_a_sheep_that_plans_beside_its_herd():
    pytest.importorskip("mesa")
    from examples.wolf_sheep.plan import lives

    from simenv_marl.planning import RolloutPolicy

    own, same, others = lives(3, RolloutPolicy(horizon=2, futures=1), 4)
    assert 1 <= same <= 4
    assert 1 <= others <= 4
    assert own >= 1
    assert lives(3, RULE, 4)[:2] == (same, same)  # the others are in other futures, as chance is one for all


def test_credit_for_a_decision_of_the_greenhouse():
    pytest.importorskip("mesa")
    from examples import credit

    world = next(credit.worlds())
    ways, truth = credit.measure(world, number=2, futures=3, episodes=3, seed=0)
    returns, apart, paired, *cut = ways
    assert truth > 0
    assert apart.bias == paired.bias == 0
    assert paired.deviation < apart.deviation
    assert paired.days == 2 * returns.days
    assert [way.days for way in cut] == [2 * horizon for horizon in credit.HORIZONS]
    shown = credit.table(world, ways, truth)
    assert all(way.title in shown for way in ways)
    assert "1 x" in shown.splitlines()[4]
