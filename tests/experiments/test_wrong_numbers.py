"""Runs whose numbers are known to be wrong: each is an error in its table, every time."""

import random
import warnings

import numpy as np
import pytest

from simenv_marl import RULE, evaluate, simulate
from simenv_marl.data import collect_episodes
from simenv_marl.experiments import run_experiment
from tests.worlds.models import Script, decision, define

SEEDS = range(3)

pytestmark = pytest.mark.filterwarnings("ignore")


def fates(make, points, **options):
    """The status and the error of each run, of an evaluation and its repetition."""
    given = {"points": points, "seeds": SEEDS, **options}
    frames = [evaluate(make, {"rule": {}}, **given).frame for _ in range(2)]
    for frame in frames:
        assert set(frame["seed"]) == set(SEEDS)
        if "status" not in frame:
            frame["status"], frame["error"] = "ok", None
    return [set(zip(frame["status"], frame["error"], strict=True)) for frame in frames]


def assert_errors(found, part):
    for fate in found:
        ((status, error),) = fate
        assert status == "error"
        assert part in error


FINE = [{("ok", None)}] * 2


class Casino:
    """Draws from a global generator, seeded by itself or not."""

    draw = staticmethod(random.random)
    seeds = staticmethod(lambda seed: None)

    def reset(self, seed):
        self.seeds(seed)
        self.stakes = self.draw()

    def run(self):
        for _ in range(3):
            self.stakes += self.bet()

    def bet(self):
        return self.draw()


class NumpyCasino(Casino):
    draw = staticmethod(np.random.random)


class BusyCasino(Casino):
    draw = staticmethod(lambda: sum(random.random() for _ in range(2000)))


class SeededCasino(Casino):
    seeds = staticmethod(random.seed)


class SeededNumpyCasino(NumpyCasino):
    seeds = staticmethod(np.random.seed)


BET = {f"{__name__}.Casino.bet": define(agent="gambler", reward_mapping=lambda game: game.stakes)}


@pytest.mark.parametrize("kind", [Casino, NumpyCasino, BusyCasino])
@pytest.mark.parametrize("arguments", [{}, {"batched": True}, {"workers": 2}], ids=str)
def test_evaluate_marks_unseeded_draws_from_global_generators_as_errors(kind, arguments):
    assert_errors(fates(kind, BET, **arguments), "global_rng=True")
    assert fates(kind, BET, global_rng=True, **arguments) == FINE


@pytest.mark.parametrize("kind", [SeededCasino, SeededNumpyCasino])
def test_evaluate_marks_global_seeding_as_error_if_runs_are_batched(kind):
    assert fates(kind, BET) == FINE
    assert_errors(fates(kind, BET, batched=True), "influence each other")
    assert fates(kind, BET, batched=True, batch_size=1) == FINE


class Herd:
    """Animals that are freed before the reward of their decision is known."""

    def reset(self, seed):
        self.seed = seed

    def run(self):
        for _ in range(2):
            Animal().graze()


class Animal:
    food = 5.0

    def graze(self):
        return 1


def grazing(**changes):
    return {f"{__name__}.Animal.graze": define(agent="animal", **changes)}


def test_evaluate_marks_rewards_lost_with_freed_entities_as_errors():
    found = fates(Herd, grazing(reward_mapping=lambda animal: animal.food))
    assert_errors(found, "the reward is 0.0")
    observe = {"observation_space_mapping": lambda animal: [animal.food, 0.0]}
    unpaid = grazing(reward_mapping=lambda: 1.0, **observe)  # the last observation stays
    assert fates(Herd, unpaid) == FINE


def test_evaluate_marks_rewards_mixed_by_two_objects_as_errors():
    class Pair:
        def reset(self, seed):
            self.animals = [Animal(), Animal()]

        def run(self):
            for animal in self.animals:
                animal.graze()

    points = {f"{__name__}.Animal.graze": define(reward_mapping=lambda animal: animal.food)}
    assert_errors(fates(Pair, points), "rewards and differences mix")
    meant = grazing(reward_mapping=lambda animal: animal.food)
    assert fates(Pair, meant) == FINE


def stubborn(decide):
    """A simulation that goes on after its exit."""

    def main(script):
        while True:
            try:
                decide()
            except BaseException:
                script.log.append("went on")

    return lambda: Script(main)


def test_evaluate_marks_models_that_do_not_unwind_as_errors():
    decide = decision(agent="chooser")
    found = fates(stubborn(decide), decide, max_steps=2, metric=lambda script: len(script.log))
    assert_errors(found, "refuses to end")


def test_evaluate_summary_shows_errors_instead_of_numbers():
    class Moody(Casino):
        def reset(self, seed):
            self.stakes = self.draw() if seed == 1 else float(seed)

        def bet(self):
            return 1.0

    found = evaluate(Moody, {"rule": {}, "other": {}}, seeds=SEEDS, points=BET, baseline="rule")
    for metric in ("return", "length"):
        summary = found.summary(metric)
        assert np.isnan(summary["mean"]).all()
        assert summary["note"].str.startswith("a value is missing").all()
    assert np.isnan(found.improvement()["probability"]).all()
    assert found.values()["rule"].notna().tolist() == [True, False, True]
    found.plot()


def test_run_experiment_stores_the_error_of_each_run(tmp_path):
    for _ in range(2):
        table = run_experiment(Casino, [{}, {}], seeds=SEEDS, points=BET, store=tmp_path)
        assert set(table["status"]) == {"error"}
        assert table["error"].str.contains("global_rng=True").all()
        assert table["return"].isna().all()
    again = {"retry_errors": True, "global_rng": True}
    table = run_experiment(Casino, [{}, {}], seeds=SEEDS, points=BET, store=tmp_path, **again)
    assert set(table["status"]) == {"ok"}


def test_evaluate_warns_once_of_global_generators():
    class Fresh(Casino):
        pass

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        simulate(Fresh, points=BET, seed=1)
        fates(Fresh, BET)
    assert len([one for one in caught if "global generator" in str(one.message)]) == 1


@pytest.mark.parametrize("workers", [0, 2])
def test_collect_episodes_marks_episodes_with_wrong_numbers(workers):
    policies = {"gambler": RULE}
    for _ in range(2):
        found = collect_episodes(Casino, policies, seeds=SEEDS, points=BET, workers=workers)
        assert all("global_rng=True" in error for error in found["gambler"].errors)
        assert len(found["gambler"].errors) == len(SEEDS)
    fine = collect_episodes(Casino, policies, seeds=SEEDS, points=BET, global_rng=True)
    assert fine["gambler"].errors == ("", "", "")
