"""Demonstrations by the rule and by others: mixtures and comparisons.

Of data sets: ``test_minari.py``.
"""

import sys
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, simulate_many
from simenv_marl.data import (
    Mixture,
    collect_episodes,
    compare_with_rule,
    record_dataset,
    save_dataset,
)
from simenv_marl.errors import DefinitionError, MissingExtraError, OptionValueError
from tests.contract.test_simulate_many import ones
from tests.worlds.entities import Being, beings, life
from tests.worlds.models import calling, decision, plainly, script


def twos(observations):
    return [2] * len(observations)


def test_mixture_leaves_each_decision_to_one_of_its_policies():
    ant = decision(agent="ant_0", rule_action_mapping=lambda decided: 3)
    mixture = Mixture({ones: 3, twos: 1, RULE: 4})
    assert repr(mixture) == "<Mixture: 0.375 ones, 0.125 twos, 0.5 rule>"
    assert "0.5 functools.partial" in repr(Mixture([(partial(ones), 1), (RULE, 1)]))
    found = collect_episodes(calling(*[ant] * 20), {ant: mixture}, seeds=range(100))[ant]
    component = found.extras["component"]
    assert [float((component == number).mean()) for number in range(3)] == pytest.approx(
        [0.375, 0.125, 0.5], abs=0.04
    )
    assert found.actions.tolist() == (component + 1).tolist()
    assert found.by_rule.tolist() == (component == 2).tolist()
    assert found.known.all()
    logs = [
        simulation.log
        for simulation in simulate_many(calling(*[ant] * 20), {ant: mixture}, seeds=range(2))
    ]
    assert logs == [
        [[1, 2, "rule"][own] for own in component[start : start + 20]] for start in (0, 20)
    ]


def test_mixture_choice_depends_only_on_the_seed_and_the_decision():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    mixture = Mixture(iter([(ones, 0.5), (twos, 0.5)]))

    def actions(seeds, **options):
        policies = {ant: mixture, bee: mixture}
        found = collect_episodes(
            calling(*[ant, bee] * 10), policies, points=[ant, bee], seeds=seeds, **options
        )
        of_seeds = {}
        for own in found.values():
            for seed, turn, action in zip(
                np.take(own.seeds, own.episodes), own.turns, own.actions, strict=True
            ):
                of_seeds[int(seed), int(turn)] = int(action)
        return of_seeds

    together = actions([5, 6, 2**70])
    assert (
        together
        == actions([2**70, 5, 6], batch_size=1)
        == actions([5, 6], batch_size=2) | actions([2**70])
    )
    drawn = ["".join(str(together[seed, turn]) for turn in range(20)) for seed in (5, 6, 2**70)]
    assert drawn == [
        "22222212122121111111",
        "21122111121121121212",
        "21221121222212111122",
    ]  # by SplitMix64, in any version


def test_mixture_passes_each_policy_its_own_observations():
    seen, mask = [], [0, 1, 1] + [0] * 7

    def informed(observations, infos, identities):
        masks = [info["action_mask"].tolist() for info in infos]
        seen.extend(zip(observations[:, 0].tolist(), masks, identities, strict=True))
        return [1] * len(observations), {"dropped": np.zeros(len(observations))}

    source = life("0 acts, 1 acts, 2 acts, 3 acts, 4 acts, 5 acts")
    given = {"points": beings(action_mask_mapping=lambda being: mask), "seeds": range(9)}
    own = collect_episodes(source, {Being.act: Mixture({informed: 1, twos: 1})}, **given)[Being.act]
    rows = np.flatnonzero(own.extras["component"] == 0)
    expected = [
        (own.observations[r, 0], mask, (own.seeds[own.episodes[r]], own.turns[r])) for r in rows
    ]
    assert sorted(seen) == sorted(expected)
    assert own.extras.keys() == {"component"}


def test_mixture_works_with_composite_spaces():
    space = spaces.Dict(how=spaces.Box(0, 9, (2,), np.float32), what=spaces.Discrete(3))
    observed = {
        "observation_space": space,
        "observation_space_mapping": lambda: {"how": [1, 2], "what": 1},
    }
    ant = decision(agent="ant_0", action_space=space, **observed)
    policies = {ant: Mixture({(lambda observations: observations): 1, RULE: 1})}
    found = collect_episodes(calling(*[ant] * 9), policies, seeds=[1, 2])[ant]
    own = ~found.by_rule
    assert 0 < own.sum() < 18
    assert found.actions["how"][own].tolist() == [[1, 2]] * own.sum()
    assert found.actions["what"][own].tolist() == [1] * own.sum()


@pytest.mark.parametrize(
    "parts",
    [
        *({}, [], [ones], {"ones": 1}, [(ones, 1, 2)], {ones: 0}),
        *(
            {ones: 1, twos: weight}
            for weight in (-1, -1e-9, float("inf"), float("nan"), "1", True, None, 1j)
        ),
    ],
    ids=plainly,
)
def test_mixture_refuses_invalid_arguments(parts):
    with pytest.raises(OptionValueError, match=r"mixture|weight"):
        Mixture(parts)


def test_record_dataset_needs_minari_and_one_name_for_each_policy(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari.dataset.minari_dataset", None)
    monkeypatch.setitem(sys.modules, "minari", None)
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    both, given = {"ant_0": ones, "bee_0": ones}, {"points": [ant, bee], "seeds": [1]}
    found = collect_episodes(calling(ant, bee), both, **given)
    for dataset_id, policies, told in (
        ("both-v0", both, "2 policies"),
        ({"ant_0": "same-v0", "bee_0": "same-v0"}, both, "own"),
        ({"cat_0": "cats-v0"}, both, "cat_0"),
        (None, both, "dataset_id"),
        ({"ant_0": 3}, both, "dataset_id"),
        ("ants-v0", ones, "policies"),
    ):
        with pytest.raises(OptionValueError, match=told):
            record_dataset(dataset_id, calling(ant, bee), policies, **given)
    with pytest.raises(OptionValueError, match="under each key"):
        save_dataset("ants-v0", found)
    with pytest.raises(MissingExtraError, match=r"marl\[minari\]"):
        save_dataset("ants-v0", found["ant_0"])
    with pytest.raises(MissingExtraError, match=r"marl\[minari\]"):
        record_dataset("ants-v0", calling(ant, bee), {ant: ones}, **given)


def test_record_dataset_refuses_unknown_rule_actions_before_it_runs(monkeypatch):
    monkeypatch.setattr("simenv_marl.data.demonstrations._free_path", lambda name: None)

    class Ran(Exception):
        pass

    def main(simulation):
        raise Ran

    ant, bee = (
        decision(agent="ant_0"),
        decision(agent="bee_0", rule_action_mapping=lambda decided: 3),
    )
    unknown = DefinitionError, r"choose.*rule_action_mapping"
    cases = [(ant, Mixture({ones: 1, RULE: 0}), Ran, None)]
    for policy in (RULE, Mixture({ones: 1, RULE: 1}), Mixture({Mixture({RULE: 1}): 1})):
        cases += [(ant, policy, *unknown), (bee, policy, Ran, None)]
    for point, policy, error, match in cases:
        with pytest.raises(error, match=match):
            record_dataset("ants-v0", script(main), {point: policy}, points=[ant, bee], seeds=[1])
    with pytest.raises(DefinitionError, match="rule_action_mapping"):
        compare_with_rule(script(main), {ant: ones}, points=[ant], seeds=[1])


TOLD = beings(rule_action_mapping=lambda decided, being: being.health)


def crowd(simulation):
    simulation.crowd = [Being(number) for number in range(3)]
    for step in range(3):
        for being in simulation.crowd:
            being.health = step
            being.act()


@pytest.mark.parametrize("size", [1, 8])
def test_compare_with_rule_asks_policies_but_executes_the_models_rule(size):
    given = {"points": TOLD, "seeds": [1, 2], "batch_size": size}
    found = compare_with_rule(script(crowd), {Being.act: ones}, **given)[Being.act]
    alone = collect_episodes(script(crowd), {Being.act: RULE}, **given)[Being.act]
    assert found.policy_actions.tolist() == [1] * 18
    assert found.agreements.tolist() == [False, True, False] * 6
    assert found.agreement == pytest.approx(1 / 3)
    assert "0.333" in repr(found)
    assert found.trajectories.actions.tolist() == [0, 1, 2] * 6
    assert found.trajectories.extras == {}
    for name in (
        "observations",
        "actions",
        "rewards",
        "terminations",
        "starts",
        "episodes",
        "by_rule",
        "turns",
    ):
        assert np.array_equal(getattr(found.trajectories, name), getattr(alone, name)), name


def test_compare_with_rule_counts_a_policys_rule_answer_as_agreement():
    policy = Mixture({RULE: 1, (lambda seen: [7] * len(seen)): 1})
    found = compare_with_rule(script(crowd), {Being.act: policy}, points=TOLD, seeds=range(4))[
        Being.act
    ]
    assert set(np.unique(found.policy_actions)) == {0, 1, 2, 7}
    assert found.agreements.tolist() == (found.policy_actions != 7).tolist()


def test_compare_with_rule_accepts_numbers_within_a_tolerance():
    space = spaces.Dict(how=spaces.Box(-9, 9, (2,), np.float32), what=spaces.Discrete(3))
    answers = [
        {"how": np.array(how, np.float32), "what": what}
        for how, what in (([1, 2], 1), ([1.5, 2], 1), ([1, 2.75], 1), ([1, 2], 2))
    ]
    ant = decision(
        agent="ant_0", action_space=space, rule_action_mapping=lambda decided: answers[0]
    )
    for tolerance, number in ((0.0, 1), (0.5, 2), (1, 3)):
        found = compare_with_rule(
            calling(ant), {ant: lambda seen: answers}, seeds=range(4), tolerance=tolerance
        )
        assert found[ant].agreements.tolist() == [True] * number + [False] * (4 - number)


def test_compare_with_rule_compares_actions_of_all_spaces():
    space = spaces.Tuple(
        [spaces.MultiDiscrete([3, 3]), spaces.Text(5), spaces.Dict(a=spaces.MultiBinary(2))]
    )

    def action(numbers=(1, 2), word="hello", bits=(0, 1)):
        return np.array(numbers), word, {"a": np.array(bits, np.int8)}

    ant = decision(agent="ant_0", action_space=space, rule_action_mapping=lambda decided: action())
    answers = iter(
        [action(), action(numbers=(1, 1)), action(word="hell"), action(bits=(1, 1)), RULE]
    )
    found = compare_with_rule(calling(*[ant] * 5), {ant: lambda seen: [next(answers)]}, seeds=[1])[
        ant
    ]
    assert found.agreements.tolist() == [True, False, False, False, True]
    assert found.policy_actions[1].tolist() == ["hello", "hello", "hell", "hello", "hello"]


def test_compare_with_rule_takes_policies_even_if_one_never_decides():
    ant, bee = (
        decision(agent=name, rule_action_mapping=lambda decided: 1) for name in ("ant_0", "bee_0")
    )
    cat, logs = decision(agent="cat_0"), []
    source = script(lambda simulation: logs.append([ant(), cat(), ant()]))
    given = {"points": [ant, bee, cat], "seeds": [1], "others": {cat: twos}}
    found = compare_with_rule(source, {"ant_0": ones, bee: ones}, **given)
    assert logs == [["rule", 2, "rule"]]  # others may decide
    assert list(found) == ["ant_0", bee]
    assert found["ant_0"].agreement == 1.0
    assert found["ant_0"].policy_actions.tolist() == [1, 1]
    assert np.isnan(found[bee].agreement)


def test_compare_with_rule_refuses_rule_decisions_without_an_action():
    points = beings(rule_action_mapping=lambda decided, being: None if being.number == 2 else 1)
    with pytest.raises(
        DefinitionError, match=r"in 3 of 9 decisions .*'being_2' at turn 2 of the episode of seed 8"
    ):
        compare_with_rule(script(crowd), {Being.act: ones}, points=points, seeds=[8])
    ant = decision(rule_action_mapping=lambda decided: None)
    with pytest.raises(DefinitionError, match=r"in 2 of 2 decisions .* of the episode of seed 8"):
        compare_with_rule(calling(ant), {ant: ones}, seeds=[8, 9])


@pytest.mark.parametrize(
    "wrong",
    [
        {"policies": ones},
        {"policies": {"ant_0": RULE}},
        {"tolerance": -1},
        {"others": 3},
        {"tolerance": "1"},
    ],
    ids=plainly,
)
def test_compare_with_rule_refuses_invalid_arguments(wrong):
    ant = decision(agent="ant_0", rule_action_mapping=lambda decided: 1)
    given = {"policies": {ant: ones}, "seeds": [1], **wrong}
    with pytest.raises(OptionValueError, match=next(iter(wrong))):
        compare_with_rule(calling(ant), given.pop("policies"), **given)
