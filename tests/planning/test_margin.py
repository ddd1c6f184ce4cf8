"""The margin over the rule: worse candidates are not taken, and uninformative futures warn."""

import random

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, single_env
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy, action_values, rollouts, values
from tests.planning.test_action_values import begun
from tests.worlds.models import define


class World:
    """Pays a gain for each action but that of its rule, and noise.

    An action draws as many numbers as it is large.
    """

    gain, noise, shared, mean_time = 0.0, 1.0, False, 0.0
    turns = 30

    def reset(self, seed=None):
        self.clock, self.paid = 0.0, 0.0
        self.random, self.other = random.Random(seed), random.Random(seed)

    def reseed(self, seed):
        self.random.seed(seed)
        self.other.seed(seed)

    def time(self):
        return self.clock

    def run(self):
        for turn in range(self.turns):
            action = self.act()
            for _ in range(action):
                (self.random if self.shared else self.other).random()
            self.paid = self.gain * (action > 0) + self.noise * self.random.gauss(0, 1)
            self.clock += self.other.expovariate(1 / self.mean_time) if self.mean_time else turn % 3

    @define(action_space=spaces.Discrete(4), reward_mapping=lambda world: world.paid)
    def act(self):
        return 0


def world(**given):
    return type("SomeWorld", (World,), given)


def made(model, **options):
    return begun(single_env(model, World.act, **options), 1)


@pytest.fixture(autouse=True)
def nothing_was_warned_of(monkeypatch):
    monkeypatch.setattr(values, "_SETTLED", set())


def share_of_rule(kind, model, margin, decisions):
    env, answers = made(model), []
    for _ in range(decisions):
        answers.append(
            kind(actions=[1, 2, 3], futures=4, horizon=1, margin=margin, method="replay")
            .choose(env)
            .best
        )
        env.step(0)
    return sum(answer is RULE for answer in answers) / decisions


def test_rollout_policy_margin_rarely_lets_an_action_win_by_chance():
    assert share_of_rule(RolloutPolicy, world(shared=True), 4.0, 12) >= 0.9
    assert 0.2 <= share_of_rule(RolloutPolicy, world(shared=True), 0.0, 12) <= 0.85


@pytest.mark.parametrize("kind", [RolloutPolicy, TreeSearchPolicy])
def test_rollout_policy_keeps_the_rule_unless_an_action_is_better(kind):
    assert share_of_rule(kind, world(gain=0.01), 1.0, 3) == 0.0  # the same noise meets all
    assert share_of_rule(kind, world(gain=-0.01), 0.0, 3) == 1.0
    assert share_of_rule(kind, world(), 0.0, 3) == 1.0


@pytest.mark.thorough
@pytest.mark.parametrize(("futures", "fresh"), [(3, 8), (12, 12)])
@pytest.mark.parametrize("kind", [RolloutPolicy, TreeSearchPolicy])
def test_rollout_policy_compares_its_best_action_on_fresh_futures(
    kind, futures, fresh, monkeypatch
):
    calls, branch = [], rollouts.branch

    def noted(*given, seeds, **options):
        calls.append(seeds)
        return branch(*given, seeds=seeds, **options)

    monkeypatch.setattr(rollouts, "branch", noted)
    planner = kind(actions=[1, 2], futures=futures, horizon=1, method="fork")
    told = planner.choose(made(world(gain=1.0)))
    searched, confirmed = [seed for seeds in calls[:-1] for seed in seeds], calls[-1]
    assert told.best != RULE
    assert len(searched) == told.counts.sum() >= 3 * futures - 1
    assert confirmed[:fresh] == confirmed[fresh:]
    assert len(set(confirmed)) == fresh
    assert not set(confirmed) & set(searched)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [RolloutPolicy, TreeSearchPolicy])
@pytest.mark.filterwarnings("ignore:SomeWorld cannot draw")
def test_rollout_policy_ignores_its_margin_if_the_model_is_deterministic(kind):
    for gain, best in ((1e-6, 1), (0.0, RULE), (-1e-6, RULE)):
        assert (
            kind(actions=[1, 0], horizon=1, margin=1e9)
            .choose(made(world(gain=gain, reseed=None)))
            .best
            is best
        )


def test_action_values_report_how_returns_of_actions_correlate():
    def correlation(model, **given):
        return action_values(
            made(model), horizon=1, **{"futures": 15, "method": "replay"} | given
        ).correlation

    assert correlation(world(gain=1.0)) == pytest.approx(1.0)
    assert abs(correlation(world(shared=True), actions=[0, 3])) < 0.6
    assert correlation(world(), futures=3) == pytest.approx(1.0)
    assert np.isnan([correlation(world(), futures=2), correlation(world(), actions=[1])]).all()
    with pytest.warns(UserWarning, match="are the same"):
        assert np.isnan(correlation(type("Quiet", (World,), {"noise": 0.0})))


class Fading(World):
    """Draws nothing after its first turn."""

    turns = 2

    @property
    def noise(self):
        return float(not self.paid)


OWN = {"reseed": lambda world, seed: world.other.seed(seed)}
MOVING = {"turns": 10, "mean_time": 1.0}
SOUND = [
    (Fading, {}),
    (world(), {"horizon": 5}),
    (world(**MOVING), {"horizon": 5.0, "horizon_by": "time"}),
    (world(**MOVING), {"horizon": None}),
    (world(shared=True), {"futures": 15}),  # too few to know
    (world(gain=1.0, reseed=None), {"actions": [0]}),
]
DOUBTFUL = [
    ("all futures of SomeWorld are the same.* reseed must seed each", world(**OWN), {}, {}),
    (
        "all futures of SomeWorld are the same.* global_rng",
        world(reseed=None),
        {"global_rng": True},
        {},
    ),
    (
        "correlate by .* a generator for itself",
        world(shared=True),
        {},
        {"actions": [0, 3], "futures": 60},
    ),
    ('the times between .* use horizon_by="time"', world(**MOVING), {}, {"horizon": 5}),
]


@pytest.mark.parametrize(("match", "model", "options", "given"), DOUBTFUL)
def test_action_values_warn_once_of_futures_that_tell_nothing(match, model, options, given):
    env = made(model, **options)
    with pytest.warns(UserWarning, match=match) as caught:
        action_values(env, **{"futures": 16, "horizon": 1, "method": "replay"} | given)
    assert [found.filename for found in caught] == [__file__]
    # another would be an error
    action_values(env, **{"futures": 16, "horizon": 2, "method": "replay"} | given)


@pytest.mark.parametrize(("model", "given"), SOUND)
@pytest.mark.filterwarnings("ignore:SomeWorld cannot draw")
def test_action_values_do_not_warn_of_informative_futures(model, given):
    env = made(model)
    for _ in range(2):
        action_values(env, **{"futures": 16, "horizon": 1, "method": "replay"} | given)
        env.step(0)
