"""Minari data sets of what was decided, read again by Minari and by a learner."""

import os
from doctest import ELLIPSIS, NORMALIZE_WHITESPACE, SKIP, DocTestParser, DocTestRunner
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, TRUNCATED
from simenv_marl.data import Mixture, collect_episodes, record_dataset, save_dataset
from simenv_marl.errors import DefinitionError, OptionValueError
from tests.contract.test_simulate_many import ones
from tests.worlds.entities import Being, beings
from tests.worlds.models import Timed, calling, decision, models_of_pages_forgotten, script
from tests.worlds.vectors import same

minari = pytest.importorskip("minari")

NAME = "simenv/demo-v0"
SAID = {"author": "An", "description": "?"}


@pytest.fixture(autouse=True)
def _where_data_sets_lie(monkeypatch, tmp_path):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "data sets"))


def part(stack, rows):
    if isinstance(stack, dict):
        return {key: part(value, rows) for key, value in stack.items()}
    if isinstance(stack, tuple):
        return tuple(part(value, rows) for value in stack)
    if isinstance(stack, list):  # of texts
        return stack[rows]
    return list(stack[rows]) if stack.dtype == object else stack[rows]


def check(found, dataset):
    """A data set has just what was found."""
    assert dataset.total_episodes == len(found.starts)
    assert dataset.total_steps == len(found)
    assert (dataset.observation_space, dataset.action_space) == (
        found.observation_space,
        found.action_space,
    )
    metadata = list(dataset.storage.get_episode_metadata(range(dataset.total_episodes)))
    for place, (start, length) in enumerate(zip(found.starts, found.lengths, strict=True)):
        rows, episode = slice(start, start + length), dataset[place]
        assert same(part(episode.observations, slice(0, length)), part(found.observations, rows))
        assert same(
            part(episode.observations, slice(1, length + 1)), part(found.next_observations, rows)
        )
        assert same(episode.actions, part(found.actions, rows))
        assert same(episode.rewards, found.rewards[rows])
        assert same(episode.terminations, found.terminations[rows])
        assert same(episode.truncations, found.truncations[rows])
        assert same(episode.infos["by_rule"], np.append(found.by_rule[rows], False))
        assert all(
            same(episode.infos[name][:-1], values[rows]) for name, values in found.extras.items()
        )
        assert metadata[place]["seed"] == found.seeds[found.episodes[start]]
        assert metadata[place]["agent"] == found.names[found.agents[start]]
        assert metadata[place]["episode"] == found.episodes[start]
        assert metadata[place]["turn"] == found.turns[start]


def herd(simulation):
    """Some beings; every second one goes after its first decision."""
    simulation.crowd = [Being(number) for number in range(4)]
    for being in simulation.crowd:
        being.health = simulation.seed % 10
    for _ in range(1 + simulation.seed % 3):
        for being in list(simulation.crowd):
            being.act()
            being.health += 1
            if being.number % 2:
                being.leave()
                simulation.crowd.remove(being)
    return TRUNCATED


def thirds(seen):
    return seen[:, 1].astype(int) % 3


@pytest.mark.parametrize(
    ("policy", "name"),
    [
        (thirds, "thirds"),
        (RULE, "rule"),
        (Mixture({RULE: 1, ones: 1}), "<Mixture: 0.5 rule, 0.5 ones>"),
    ],
)
def test_record_dataset_stores_episodes_and_the_policys_name(policy, name):
    points = beings(rule_action_mapping=lambda decided, being: being.health)
    given = {"points": points, "seeds": [3, 1, 5, 2**70]}
    recorded = record_dataset(NAME, script(herd), {Being.act: policy}, batch_size=2, **given)
    found = collect_episodes(script(herd), {Being.act: policy}, **given)[Being.act]
    check(found, recorded)
    check(found, minari.load_dataset(NAME))
    assert recorded.storage.metadata["algorithm_name"] == name
    assert found.actions[found.by_rule].tolist() == found.observations[found.by_rule, 1].tolist()
    sampled = list(minari.load_dataset(NAME).sample_episodes(5))
    assert all(len(episode.observations) == len(episode.actions) + 1 for episode in sampled)


SPACES = [
    spaces.Discrete(5),
    spaces.Box(-2, 2, (2, 3), np.float32),
    spaces.MultiDiscrete([3, 4]),
    spaces.MultiBinary(3),
    spaces.Dict(a=spaces.Discrete(3), b=spaces.Tuple([spaces.Box(0, 1, (2,)), spaces.Discrete(2)])),
    spaces.Tuple([spaces.Text(4, charset="ab"), spaces.Box(0, 255, (4, 4, 3), np.uint8)]),
    spaces.Box(0, 255, (8, 8, 3), np.uint8),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_record_dataset_stores_all_spaces_so_that_minari_reads_them(space):
    space.seed(1)
    ant = decision(
        agent="ant_0",
        observation_space=space,
        observation_space_mapping=space.sample,
        action_space=space,
    )
    policies = {ant: lambda seen: [space.sample() for _ in range(2)]}
    found = collect_episodes(calling(ant, ant, ant), policies, seeds=[1, 2], points=ant)[ant]
    check(found, save_dataset(NAME, found))


def test_record_dataset_infos_have_one_row_per_observation():
    def main(simulation):
        simulation.log += [ant()]
        simulation.log += [ant()]

    ant = decision(agent="ant_0", action_mask_mapping=lambda: [0, 1] + [0] * 8)
    policy = lambda seen: (ones(seen), {"values": np.full((len(seen), 2), 0.5)})  # noqa: E731
    (episode,) = record_dataset(NAME, lambda: Timed(main), {ant: policy}, points=ant, seeds=[1])
    assert episode.infos.keys() == {"by_rule", "action_mask", "time", "values"}
    assert episode.infos["action_mask"].tolist() == [[0, 1] + [0] * 8] * 2 + [[1] * 10]
    assert episode.infos["time"].tolist() == [0, 10, 20]
    assert episode.infos["values"].tolist() == [[0.5, 0.5]] * 2 + [[0, 0]]


def test_record_dataset_makes_a_data_set_per_policy():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    policies = {"ant_0": ones, "bee_0": lambda seen: [2] * len(seen), ant: ones}
    names = {"ant_0": "simenv/ants-v0", "bee_0": "simenv/bees-v1"}
    written = record_dataset(
        names, calling(ant, bee, bee), policies, points=[ant, bee], seeds=[1, 2]
    )
    assert list(written) == ["ant_0", "bee_0"]
    assert set(minari.list_local_datasets()) == {"simenv/ants-v0", "simenv/bees-v1"}
    assert [episode.actions.tolist() for episode in minari.load_dataset("simenv/bees-v1")] == [
        [2, 2]
    ] * 2


def test_minari_recovers_the_environment_of_a_recorded_data_set():
    greenhouse = pytest.importorskip("examples.greenhouse_coop.env")
    policies, metadata = {"waterer_0": RULE}, {"env": "greenhouse_coop/Watering-v0"}
    record_dataset(
        NAME,
        greenhouse.GreenhouseSim,
        policies,
        points=greenhouse.WATERING,
        seeds=[5],
        metadata=metadata,
    )
    dataset = minari.load_dataset(NAME)
    env = dataset.recover_environment()
    observation, _ = env.reset(seed=5)
    assert np.array_equal(observation, dataset[0].observations[0])
    for number, action in enumerate(dataset[0].actions):
        observation, reward, *_ = env.step(action)
        assert np.allclose(observation, dataset[0].observations[number + 1])
        assert reward == pytest.approx(dataset[0].rewards[number])
    env.close()


def test_record_dataset_refuses_existing_names_before_it_runs():
    def never(simulation):
        raise AssertionError

    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    with pytest.raises(TypeError):  # half a data set is none
        record_dataset(
            NAME, calling(ant), {ant: ones}, points=ant, seeds=[1], metadata={"no such argument": 1}
        )
    record_dataset(
        NAME, calling(ant), {ant: ones}, points=ant, seeds=[1], max_steps=5, metadata=SAID
    )
    for name, main, reason in [
        (NAME, never, "already"),
        ("no name", never, "not a name"),
        ("simenv/none-v0", lambda simulation: None, "nothing to write"),
    ]:
        with pytest.raises(OptionValueError, match=reason):
            record_dataset(name, script(main), {ant: ones}, points=ant, seeds=[1])
    names = {ant: "simenv/ants-v0", bee: "simenv/bees-v0"}  # both are written, or none
    with pytest.raises(OptionValueError, match="bees-v0"):
        record_dataset(names, calling(ant), {ant: ones, bee: ones}, points=[ant, bee], seeds=[1])
    assert minari.list_local_datasets().keys() == {NAME}
    metadata = minari.load_dataset(NAME).storage.metadata
    assert metadata["algorithm_name"] == "ones"
    assert (metadata["author"], metadata["description"]) == ({"An"}, "?")
    assert "simulation" in metadata["provenance"]


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("number", [1, 2])
def test_record_dataset_leaves_no_data_set_after_an_interrupt(number, monkeypatch):
    """Neither by half a data set, nor by the first of two."""
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    names = {ant: "simenv/ants-v0", bee: "simenv/bees-v0"}
    made, create = [], minari.create_dataset_from_buffers

    def interrupted(*arguments, **options):
        made.append(create(*arguments, **options))
        if len(made) == number:
            raise KeyboardInterrupt
        return made[-1]

    monkeypatch.setattr(minari, "create_dataset_from_buffers", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_dataset(
            names, calling(ant, bee), {ant: ones, bee: ones}, points=[ant, bee], seeds=[1]
        )
    assert not minari.list_local_datasets()
    assert not list(Path(os.environ["MINARI_DATASETS_PATH"]).rglob("*-v0"))


def test_record_dataset_refuses_rule_decisions_without_an_action():
    points = beings(rule_action_mapping=lambda decided, being: None)
    with pytest.raises(DefinitionError, match="not known"):
        record_dataset(NAME, script(herd), {Being.act: lambda seen: RULE}, points=points, seeds=[1])
    assert not minari.list_local_datasets()


def test_examples_of_the_demonstrations_page_run_as_printed(monkeypatch):
    """With the examples that need Minari, which are skipped where it is not there."""
    page = Path(__file__).parents[2] / "docs" / "demonstrations.md"
    monkeypatch.syspath_prepend(page.parent)
    examples = DocTestParser().get_doctest(
        page.read_text(encoding="utf-8"), {}, page.name, str(page), 0
    )
    skipped = [example.options.pop(SKIP, False) for example in examples.examples]
    assert sum(skipped) > 3
    with models_of_pages_forgotten():
        assert DocTestRunner(optionflags=ELLIPSIS | NORMALIZE_WHITESPACE).run(examples).failed == 0
