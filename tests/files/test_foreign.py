"""Environments of examples and of other people's models are saved, and go on in a fresh process."""

import json
import random
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from simenv_marl import aec_env, joint_env, load_episode, parallel_env, save_episode, turn_env
from simenv_marl.errors import EpisodeFileError
from tests.processes import alone
from tests.worlds.saved import future, move

ENVIRONMENTS = [
    "examples.greenhouse_coop.env.raw_env",
    "examples.greenhouse_coop.env.parallel_env",
    "examples.greenhouse_coop.env.joint_env",
    "examples.greenhouse_coop.env.watering_env",
    "examples.greenhouse_coop.env.ventilation_env",
    "examples.queue_admission.env.env",
    "examples.market_seats.env.env",
    "examples.fin_base.env.team_env",
    "examples.fin_base.env.premium_env",
    "examples.energyplus_zones.env.raw_env",
    "examples.energyplus_zones.env.parallel_env",
    "simenv_marl.testing.templates.plain.env",
    "simenv_marl.testing.templates.simpy.env",
    "simenv_marl.testing.templates.mesa.env",
]
"""Functions that make environments whose parts have names."""

SIMULATIONS = {
    "sheep": ("examples.wolf_sheep.env", "Meadow", (aec_env, parallel_env, turn_env)),
    "stages": ("examples.serial_supply.env", "SerialSupply", (aec_env, turn_env, joint_env)),
    "levy": ("examples.market_seats.env", "Levied", (aec_env, parallel_env, turn_env)),
    "room": ("examples.heated_room.env", "RoomSim", (aec_env,)),
}
"""Simulations with decision points of their own, and views."""

PROCESSES = {
    "reservoirs": ("tests.outside.reservoirs", "reservoirs"),
    "town": ("examples.jvm_market.env", "market"),
    "robots": ("examples.enki_robots.env", "robots"),
    "senders": ("examples.ns3_senders.env", "senders"),
    "follower": ("examples.ros_follower.env", "follower"),
}
"""Functions that make simulations of other processes."""


def imported(module):
    """Import a module. Skip the test without a package that it needs."""
    try:
        return import_module(module)
    except ImportError as error:
        pytest.skip(f"{module} needs {error.name}")


def save(env, folder, name, **options):
    """Save an environment after 20 decisions, and what comes of it."""
    env.reset(seed=3)
    chance = random.Random(1)
    for _ in range(20):
        if move(env, chance)[1]:
            break
    save_episode(env, folder / f"{name}.jsonl", **options)
    (folder / f"{name}.future").write_text(json.dumps(future(env, 2, 20)))
    env.close()


def go_on(folder, *given):
    """Load the files of a folder, and compare what they come to.

    ``given``: the module and the name of a function that returns what the files leave open.
    """
    for path in sorted(Path(folder).glob("*.jsonl")):
        arguments = getattr(import_module(given[0]), given[1])(*given[2:]) if given else {}
        env = load_episode(path, **arguments)
        assert future(env, 2, 20) == json.loads(path.with_suffix(".future").read_text()), path
        env.close()


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_saved_episodes_of_example_envs_continue_in_a_fresh_process(name, tmp_path):
    module, _, attribute = name.rpartition(".")
    save(getattr(imported(module), attribute)(), tmp_path, name)
    alone(go_on, str(tmp_path))


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", SIMULATIONS)
def test_saved_episodes_of_example_models_continue_in_a_fresh_process(name, tmp_path):
    module, attribute, views = SIMULATIONS[name]
    found = imported(module)
    for make in views:
        options = getattr(found, "OPTIONS", {})
        save(make(getattr(found, attribute), **options), tmp_path, make.__name__)
    alone(go_on, str(tmp_path))


def test_saved_episodes_of_models_with_arguments_continue_in_a_new_process(tmp_path):
    sheep = imported("examples.wolf_sheep.env")
    meadow = partial(sheep.Meadow, 25, width=8, height=8, initial_sheep=20, initial_wolves=5)
    save(aec_env(meadow), tmp_path, "own points")
    with pytest.raises(EpisodeFileError, match=r"no dotted name.*the definition of mesa\."):
        save(aec_env(meadow, sheep.sheep_points(2)), tmp_path, "others")
    alone(go_on, str(tmp_path))


def process_of(name):
    """Return a simulation of another process, as an argument of ``load_episode``."""
    module, attribute = PROCESSES[name]
    return {"simulation": getattr(import_module(module), attribute)()}


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", PROCESSES)
def test_saved_episodes_of_models_outside_python_continue_in_a_new_process(name, tmp_path):
    problem = getattr(imported(PROCESSES[name][0]), "missing", str)()
    if problem:
        pytest.skip(problem)
    try:
        given = process_of(name)
    except RuntimeError as error:
        pytest.skip(str(error))
    with pytest.raises(EpisodeFileError, match=r"no dotted name.*the simulation: <"):
        save(aec_env(**given), tmp_path, name)
    save(aec_env(**given), tmp_path, name, unnamed=True)
    alone(go_on, str(tmp_path), __name__, "process_of", name)


def arguments_of(name):
    """Return the arguments that a file of a model of Mesa leaves open."""
    mesa_models = import_module("examples.mesa_models")
    example = next(each for each in mesa_models.EXAMPLES if each.__name__ == name)
    model, points, options = example()
    return {"simulation": mesa_models.stepped(model), "points": points, **options}


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_saved_episodes_of_mesa_models_continue_in_a_fresh_process(tmp_path):
    mesa_models = imported("examples.mesa_models")
    for example in mesa_models.EXAMPLES:
        name = example.__name__
        if name == "wolf_sheep" and mesa_models.NEEDS_SIMULATOR:
            continue
        (tmp_path / name).mkdir()
        given = arguments_of(name)
        with pytest.raises(EpisodeFileError, match="no dotted name"):
            save(aec_env(**given), tmp_path / name, name)
        save(aec_env(**given), tmp_path / name, name, unnamed=True)
    alone(go_on_with_models, str(tmp_path))


def go_on_with_models(folder):
    """Load the files of all models of Mesa."""
    for each in sorted(Path(folder).iterdir()):
        go_on(each, __name__, "arguments_of", each.name)
