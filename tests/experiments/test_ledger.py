"""What each decision was worth."""

import os
import random
import warnings

import numpy as np
import pytest
from examples.greenhouse_coop.env import WATERER, GreenhouseSim
from examples.queue_admission.env import AGENT, QueueSimulation
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, evaluate, joint_env, make_step, simulate, turn_env
from simenv_marl.data import joint_policy, turn_policy
from simenv_marl.errors import BranchError, InvalidActionError, OptionValueError
from simenv_marl.experiments import Variant, decision_values, ledger, ledgers
from simenv_marl.planning import RolloutPolicy
from simenv_marl.seats import describe
from tests.extent import examples
from tests.worlds.models import BY_DRIVER, Script, define
from tests.worlds.random_worlds import FAIR_POINTS, FAIR_POLICIES, Fair, boldest, fair_policy

COLUMNS = [
    "seed", "number", "agent", "time", "decision", "action", "rule_action", "value",
    "contribution", "skill", "luck", "error",
]  # fmt: skip

WORLDS = int(os.environ.get("LEDGER_WORLDS", "12"))
"""The bar is 1,000 worlds, which take some minutes."""

seeds = st.integers(0, 2**31 - 1)


class Dice:
    """Three throws: who decides adds to each, and its rule adds 2."""

    deterministic = False

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.total = self.last = 0.0

    def run(self):
        for _ in range(3):
            self.last = self.add() + 10 * self.random.random()
            self.total += self.last

    def add(self):
        return 2

    def reseed(self, seed):
        self.random.seed(seed)


def dice(**changes):
    """The decision point of dice: ten actions, paid by the throw."""
    given = {
        "agent": "player_0",
        "action_space_mapping": {number: number for number in range(10)},
        "reward_mapping": lambda dice: dice.last,
    }
    return {Dice.add: define(**given | changes)}


def returns_of(simulation, points, policies, seed, **options):
    """The team's return of policies, without a ledger."""
    found = evaluate(simulation, {"policies": policies}, seeds=[seed], points=points, **options)
    return found.values().loc[seed, "policies"]


# -- sums -----------------------------------------------------------------------------------------


@given(
    seed=seeds,
    driver=st.sampled_from(["greenlet", "thread"]),
    method=st.sampled_from([None, "replay"]),
    forced=st.booleans(),
    steps=st.none() | st.integers(1, 12),
)
@examples(WORLDS)
def test_ledger_contributions_add_up_to_the_difference_of_returns(
    seed, driver, method, forced, steps
):
    options = {"points": FAIR_POINTS, "skip_forced": forced, "max_steps": steps, "driver": driver}
    found = ledger(Fair, FAIR_POLICIES, seeds=[seed], method=method, **options)
    made = returns_of(Fair, policies=FAIR_POLICIES, seed=seed, **options)
    ruled = returns_of(Fair, policies=dict.fromkeys(FAIR_POINTS, RULE), seed=seed, **options)
    assert found.returns[seed] == pytest.approx(made, abs=1e-9)
    assert found.frame["contribution"].sum() == pytest.approx(made - ruled, abs=1e-9)
    if len(found.frame):
        assert found.frame["value"][0] == pytest.approx(ruled, abs=1e-9)


@pytest.mark.parametrize("method", ["fork", "replay"])
def test_ledger_baseline_can_be_any_policies(method):
    for baseline in (boldest, dict.fromkeys(FAIR_POINTS, boldest), {"warden_0": boldest}):
        by_point = baseline if isinstance(baseline, dict) else dict.fromkeys(FAIR_POINTS, baseline)
        found = ledger(
            Fair, FAIR_POLICIES, seeds=[5], points=FAIR_POINTS, baseline=baseline, method=method
        )
        expected = returns_of(
            Fair, FAIR_POINTS, {**dict.fromkeys(FAIR_POINTS, RULE), **by_point}, 5
        )
        difference = found.returns[5] - expected
        assert found.frame["contribution"].sum() == pytest.approx(difference, abs=1e-9)


def test_ledger_takes_turn_and_joint_policies_of_all_agents():
    """The learner of a turn view, and that of a joint view, whose answers are for a round."""
    roster = {next(iter(FAIR_POINTS)): [f"stall_{number}" for number in range(6)]}
    turns = turn_policy(
        lambda seen, info: int(info["action_mask"].argmax()),
        like=turn_env(Fair, FAIR_POINTS, possible_agents=roster),
    )
    joint = joint_policy(
        lambda seen: dict.fromkeys(seen, seen[WATERER][4:5] / 4), like=joint_env(GreenhouseSim)
    )
    both = {WATERER: RULE, "ventilator_0": RULE}
    short = {"max_steps": 7}
    for simulation, points, rules, policies in (
        (Fair, FAIR_POINTS, dict.fromkeys(FAIR_POINTS, RULE), turns),
        (GreenhouseSim, None, both, joint),
    ):
        there = ledger(simulation, policies, seeds=[3], points=points, **short)
        back = ledger(simulation, rules, seeds=[3], points=points, baseline=policies, **short)
        made = returns_of(simulation, points, policies, 3, **short)
        ruled = returns_of(simulation, points, rules, 3, **short)
        assert there.frame["value"][0] == pytest.approx(ruled, abs=1e-9)
        assert back.frame["value"][0] == pytest.approx(made, abs=1e-9)
        total = there.frame["contribution"].sum()
        assert total == pytest.approx(made - ruled, abs=1e-9)
        assert back.frame["contribution"].sum() == pytest.approx(-total, abs=1e-9)
        once = ledger(simulation, policies, seeds=[3], points=points, after="policy", **short)
        assert len(once.frame) == len(there.frame)


def test_ledger_can_use_a_metric_or_team_reward_in_place_of_rewards():
    def worth(fair):
        return fair.fortune

    found = ledger(Fair, FAIR_POLICIES, seeds=[1, 2], points=FAIR_POINTS, metric=worth)
    for seed in (1, 2):
        made = worth(simulate(Fair, FAIR_POLICIES, points=FAIR_POINTS, seed=seed))
        ruled = worth(simulate(Fair, seed=seed))
        assert found.returns[seed] == made
        own = found.frame[found.frame["seed"] == seed]
        assert own["contribution"].sum() == pytest.approx(made - ruled, abs=1e-9)
    team = {"team_reward": worth}
    found = ledger(Fair, FAIR_POLICIES, seeds=[1], points=FAIR_POINTS, **team)
    made = returns_of(Fair, FAIR_POINTS, FAIR_POLICIES, 1, **team)
    ruled = returns_of(Fair, FAIR_POINTS, {}, 1, **team)
    assert found.frame["contribution"].sum() == pytest.approx(made - ruled, abs=1e-9)
    with pytest.raises(OptionValueError, match="metric must return a number"):
        ledger(Fair, FAIR_POLICIES, seeds=[1], points=FAIR_POINTS, metric=lambda fair: "high")


@BY_DRIVER
def test_ledger_futures_use_copies_of_the_global_generators(driver):
    class Thrown(Dice):
        reseed = None

        def add(self):
            return random.randrange(10) + float(np.random.rand())

    points = {Thrown.add: dice()[Dice.add]}
    options = {"points": points, "global_rng": True, "driver": driver}
    policies = {"player_0": lambda seen: 9}
    found = ledger(Thrown, policies, seeds=[1], futures=2, **options)
    made, ruled = (returns_of(Thrown, policies=each, seed=1, **options) for each in (policies, {}))
    assert found.frame["contribution"].sum() == pytest.approx(made - ruled, abs=1e-9)
    assert found.frame["luck"].abs().max() > 0


def test_ledger_works_for_planning_policies_and_variants():
    """A planner gains 7 at each throw, on the futures that it draws."""
    planner = {"player_0": RolloutPolicy([2, 9], futures=2, horizon=1)}
    variant = Variant("dice", Dice, points=dice())
    frame = ledger(variant, planner, seeds=[1], method="replay").frame
    assert frame["contribution"].tolist() == pytest.approx([7.0] * 3)


def test_ledger_does_not_repeat_warnings_in_its_copies(recwarn):
    class Loud(Dice):
        def add(self):
            warnings.warn("loud", UserWarning, stacklevel=1)
            return 2

    warnings.simplefilter("always")
    points = {Loud.add: dice()[Dice.add]}
    ledger(Loud, {"player_0": lambda seen: RULE}, seeds=[1], points=points, method="replay")
    assert [str(warning.message) for warning in recwarn] == ["loud"] * 3


def test_ledger_returns_match_an_episode_without_ledger():
    for futures in (0, 2):
        found = ledger(Fair, FAIR_POLICIES, seeds=[4], points=FAIR_POINTS, futures=futures)
        assert found.returns[4] == pytest.approx(returns_of(Fair, FAIR_POINTS, FAIR_POLICIES, 4))


# -- the rule decides once ------------------------------------------------------------------------


def test_ledger_replaces_one_decision_by_the_rule_with_after_policy():
    found = ledger(Fair, FAIR_POLICIES, seeds=[5], points=FAIR_POINTS, after="policy")
    assert len(found.frame) > 4
    for place, value in enumerate(found.frame["value"]):
        counted = iter(range(1000))

        def one_by_rule(observation, info, *, place=place, counted=counted):
            return RULE if next(counted) == place else fair_policy(observation, info)

        expected = returns_of(Fair, FAIR_POINTS, dict.fromkeys(FAIR_POINTS, one_by_rule), 5)
        assert value == pytest.approx(expected, abs=1e-9)
    worth = found.returns[5] - found.frame["value"]
    assert found.frame["contribution"].tolist() == worth.tolist()


@pytest.mark.thorough
def test_ledger_ranks_planted_mistakes_among_the_worst():
    mistakes = set(range(5, 95, 9))

    def careful(observation):
        if round(float(observation[3]) * 100) in mistakes:
            return [0.5]
        return [min(1.0, max(0.0, 0.33 - 0.6 * float(observation[4])))]

    frame = ledger(GreenhouseSim, {WATERER: careful}, seeds=[1, 2], after="policy").frame
    for _, own in frame.groupby("seed"):
        worst = own.nsmallest(10, "contribution")
        assert len({number - 1 for number in worst["number"]} & mistakes) >= 9


# -- skill and luck -------------------------------------------------------------------------------


def test_ledger_separates_skill_from_luck():
    found = ledger(Dice, {"player_0": lambda seen: 5}, seeds=[1, 2], points=dice(), futures=6)
    frame = found.frame
    assert frame["skill"].tolist() == pytest.approx([3.0] * 6)  # chance is common
    assert frame["error"].tolist() == pytest.approx([0.0] * 6, abs=1e-9)
    assert frame["luck"].abs().min() > 0.01
    assert frame["contribution"].tolist() == pytest.approx([3.0] * 6)
    for seed, own in frame.groupby("seed"):
        total = own["value"].iloc[0] + own["skill"].sum() + own["luck"].sum()
        assert total == pytest.approx(found.returns[seed], abs=1e-9)


@given(seed=seeds)
@examples(4)
def test_ledger_value_skill_and_luck_add_up_to_the_return(seed):
    found = ledger(Fair, FAIR_POLICIES, seeds=[seed], points=FAIR_POINTS, futures=3)
    if len(found.frame):
        sums = found.frame[["skill", "luck"]].sum().sum()
        assert found.frame["value"][0] + sums == pytest.approx(found.returns[seed], abs=1e-9)
    once = ledger(
        Fair, FAIR_POLICIES, seeds=[seed], points=FAIR_POINTS, futures=2, after="policy"
    ).frame
    total = once["value"] + once["skill"] + once["luck"]
    assert total.tolist() == pytest.approx([found.returns[seed]] * len(once))


def test_ledger_of_a_deterministic_simulation_has_no_luck():
    class Fixed(Dice):
        deterministic = True

        def reset(self, seed=None):
            super().reset(0)

        def reseed(self, seed):
            raise AssertionError("there is one future")

    for futures in (0, 4):
        frame = ledger(
            Fixed, {"player_0": lambda seen: 1}, seeds=[1], points=dice(), futures=futures
        ).frame
        assert frame["skill"].tolist() == frame["contribution"].tolist()
        assert frame[["luck", "error"]].to_numpy().tolist() == [[0.0, 0.0]] * 3
    frame = ledger(Dice, {"player_0": lambda seen: 1}, seeds=[1], points=dice()).frame
    assert frame[["skill", "luck"]].isna().all(axis=None)
    assert frame["error"].tolist() == [0.0] * 3


# -- the table ------------------------------------------------------------------------------------


def test_ledger_frame_describes_decisions_by_their_labels():
    policies = {AGENT: lambda seen: 1 - int(seen[1])}
    found = ledger(QueueSimulation, policies, seeds=[3, 4], max_steps=20)
    frame = found.frame
    assert list(frame.columns) == COLUMNS
    assert frame["number"].tolist() == [*range(1, 21)] * 2
    assert set(frame["agent"]) == {AGENT}
    assert set(frame["rule_action"]) == {1}
    assert frame["time"].is_monotonic_increasing is False
    assert frame["time"][:20].is_monotonic_increasing
    words = {0: "turn it away", 1: "let it in"}
    assert [words[action] for action in frame["action"]] == frame["decision"].tolist()
    summary = found.summary()
    assert summary.index.names == ["agent", "point"]
    [(agent, point)] = summary.index
    assert (agent, point) == (AGENT, "examples.queue_admission.model.Queue.admit")
    sums = frame.groupby("seed")["contribution"].sum()
    assert summary["contribution"].iloc[0] == pytest.approx(sums.mean())
    assert summary["decisions"].iloc[0] == 20


def test_ledger_frame_describes_box_actions_and_rule_decisions():
    policies = {WATERER: lambda seen: [0.06] if seen[3] < 0.02 else RULE}
    frame = ledger(GreenhouseSim, policies, seeds=[1], max_steps=4).frame
    assert (
        frame["decision"].tolist()
        == ["share of 1000 litres: 0.06"] * 2 + ["share of 1000 litres: 0.2"] * 2
    )
    assert [*map(len, frame["action"])] == [1] * 4
    assert frame["action"].str[0].tolist() == pytest.approx([0.06, 0.06, 0.2, 0.2])
    assert frame["rule_action"].str[0].tolist() == pytest.approx([0.2] * 4)
    assert frame["time"].isna().all()
    assert frame["contribution"].tolist()[2:] == [0.0, 0.0]


def test_ledger_frame_of_an_agent_without_decisions_is_empty():
    simulation = Script(lambda simulation: None)
    found = ledger(simulation, {"player_0": lambda seen: 0}, seeds=[1], points=dice())
    assert list(found.frame.columns) == COLUMNS
    assert len(found.frame) == 0
    assert len(found.summary()) == 0


def test_ledger_sample_has_some_of_the_decisions():
    given = {"seeds": range(4), "points": FAIR_POINTS, "futures": 2, "method": "replay"}
    whole = ledger(Fair, FAIR_POLICIES, **given).frame
    some = ledger(Fair, FAIR_POLICIES, **given, sample=0.3).frame
    again = ledger(Fair, FAIR_POLICIES, **given, sample=0.3).frame
    assert 0 < len(some) < len(whole)
    assert some.equals(again)
    both = some.merge(whole, on=["seed", "number"], suffixes=("", "_whole"))
    assert len(both) == len(some)
    for name in ("value", "contribution", "skill", "luck"):
        assert both[name].tolist() == both[f"{name}_whole"].tolist()


def test_ledger_plot_marks_ten_decisions():
    found = ledger(Fair, FAIR_POLICIES, seeds=range(3), points=FAIR_POINTS)
    axes = found.plot().axes[0]
    words = [text.get_text() for text in axes.get_legend().get_texts()]
    assert len(words) == min(10, len(found.frame))
    last = found.frame[found.frame["seed"] == 0]["contribution"].sum()
    assert axes.lines[1].get_ydata()[-1] == pytest.approx(last)
    biggest = found.frame["contribution"].abs().idxmax()
    assert words[0].startswith("{agent}: {decision}".format(**found.frame.loc[biggest]))
    assert ledger(Fair, FAIR_POLICIES, seeds=[1], points=FAIR_POINTS, after="policy").plot().axes
    nothing = Script(lambda simulation: None)
    assert ledger(nothing, {"player_0": boldest}, seeds=[1], points=dice()).plot().axes


def test_long_ledger_warns_of_its_duration_beforehand(monkeypatch):
    monkeypatch.setattr(ledgers, "LONG", 0.0)
    with pytest.warns(UserWarning, match=r"about \d+ minutes"):
        ledger(Dice, {"player_0": lambda seen: 1}, seeds=[1], points=dice())


def test_ledger_refuses_invalid_arguments():
    given = {"seeds": [1], "points": dice()}
    policies = {"player_0": lambda seen: 1}
    for wrong, text in (
        ({"after": "chance"}, 'after must be "rule" or "policy"'),
        ({"futures": -1}, "futures must be an integer"),
        ({"sample": 0}, "sample must be a share"),
        ({"sample": 1.5}, "sample must be a share"),
        ({"metric": 3}, "metric must be a callable"),
        ({"seeds": [1, 1]}, "occurs twice"),
        ({"baseline": "rule"}, "it is no policy"),
    ):
        with pytest.raises((OptionValueError, TypeError), match=text):
            ledger(Dice, policies, **given | wrong)

    async def slow(observation):
        return 1

    with pytest.raises(OptionValueError, match="fallback"):
        ledger(Dice, policies, baseline=slow, **given)
    with pytest.raises(OptionValueError, match="fallback"):
        ledger(Dice, {"player_0": slow}, after="policy", **given)
    assert len(ledger(Dice, {"player_0": slow}, **given).frame) == 3
    with pytest.raises(InvalidActionError):
        ledger(Dice, {"player_0": lambda seen: 99}, **given)

    class Unseeded(Dice):
        reseed = None

    with pytest.raises(BranchError, match="reseed"):
        ledger(Unseeded, policies, futures=2, **given)


# -- decision values ------------------------------------------------------------------------------


def test_decision_values_has_a_row_for_each_legal_action():
    found = decision_values(
        Dice, seeds=[1, 2], points=dice(), futures=4, describe=describe, method="replay"
    )
    assert list(found.columns) == [
        "seed", "number", "agent", "time", "action", "label", "value", "error", "by_rule", "prompt",
    ]  # fmt: skip
    assert len(found) == 2 * 3 * 10
    first = found[(found["seed"] == 1) & (found["number"] == 1)]
    gains = first["value"] - first["value"].iloc[0]
    assert gains.tolist() == pytest.approx([*range(10)])
    assert first["by_rule"].tolist() == [action == 2 for action in range(10)]
    assert first["label"].tolist() == [str(action) for action in range(10)]
    assert first["prompt"].nunique() == 1
    assert "0: 0" in first["prompt"].iloc[0] or "9" in first["prompt"].iloc[0]
    assert "prompt" not in decision_values(Dice, seeds=[1], points=dice(), futures=0)


@pytest.mark.thorough
def test_decision_values_has_no_row_for_masked_actions():
    warden = {"warden_0": boldest}
    found = decision_values(Fair, warden, seeds=[1, 3], points=FAIR_POINTS, futures=2)
    assert set(found["agent"]) == {"warden_0"}
    chosen = ledger(Fair, warden, seeds=[1, 3], points=FAIR_POINTS).frame
    last = found.groupby(["seed", "number"])["action"].max()
    assert last.tolist() == chosen["action"].tolist()
    exact = decision_values(Fair, warden, seeds=[1, 3], points=FAIR_POINTS, futures=0)
    assert exact["error"].tolist() == [0.0] * len(exact)


def test_decision_values_horizon_counts_decisions_of_the_agent():
    class Later(Dice):
        """A high number pays at once, and costs more at the second decision after it."""

        def run(self):
            values = []
            for number in range(5):
                values.append(self.add())
                before = values[number - 1] if number else 0
                self.last = values[-1] - 3.0 * before

    points = {Later.add: dice()[Dice.add]}
    given = {"seeds": [1], "points": points, "futures": 0, "method": "replay"}
    with pytest.warns(UserWarning, match="best action changes"):
        near = decision_values(Later, horizon=1, **given)
    far = decision_values(Later, horizon=2, **given)
    best = near.loc[near.groupby("number")["value"].idxmax(), "action"]
    assert best.tolist()[:4] == [9] * 4
    best = far.loc[far.groupby("number")["value"].idxmax(), "action"]
    assert best.tolist()[:4] == [0] * 4


def test_decision_values_metric_is_read_at_the_horizon():
    totals = decision_values(
        Dice, seeds=[1], points=dice(), futures=0, horizon=1, metric=lambda dice: dice.last
    )
    first = totals[totals["number"] == 1]["value"].to_numpy()
    assert np.diff(first).tolist() == pytest.approx([1.0] * 9)


def test_decision_values_refuses_actions_that_cannot_be_listed():
    with pytest.raises(OptionValueError, match="Discrete"):
        decision_values(GreenhouseSim, seeds=[1])
    with pytest.raises(OptionValueError, match="horizon must be"):
        decision_values(Dice, seeds=[1], points=dice(), horizon=0)
    unknown = {Dice.add: make_step(
        observation_space=spaces.Box(-1, 1, (1,)), observation_space_mapping=lambda dice: [0],
        action_space=spaces.Discrete(2), action_space_mapping=lambda action: action,
        reward_mapping=lambda dice: dice.last, agent="player_0",
    )}  # fmt: skip
    found = decision_values(Dice, seeds=[1], points=unknown, futures=0)
    assert found["by_rule"].tolist() == [None] * 6
