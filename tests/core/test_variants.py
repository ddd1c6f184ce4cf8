"""Variants: a model with all changes of an experiment under one name, and its provenance."""

import json
import pickle
from dataclasses import FrozenInstanceError, replace
from importlib.metadata import version

import cloudpickle
import numpy as np
import pytest

from simenv_marl import RULE, aec_env, generate_env, joint_env, simulate, single_env
from simenv_marl.errors import (
    HandlerError,
    OptionValueError,
    SimulationError,
    UnknownOptionError,
    UnknownPointError,
)
from simenv_marl.experiments import Variant, provenance
from simenv_marl.plugins import ChangedResult
from tests.worlds.models import Script, decision, define, play


class Farm(Script):
    """A farm that asks once for each of its fields."""

    def __init__(self, fields=2, price=1):
        super().__init__(None)
        self.fields, self.price = fields, price

    def run(self):
        for field in range(self.fields):
            self.log.append((self.sow(field), self.harvest(field)))

    def sow(self, field):
        return "wheat"

    def harvest(self, field):
        return self.price


SOW, HARVEST = f"{__name__}.Farm.sow", f"{__name__}.Farm.harvest"
POINTS = {SOW: define(agent="sower_0"), HARVEST: define(agent="reaper_0")}


def dearer(farm, field, _result):
    return ChangedResult(_result * 10)


def five(observation):
    return 5


LARGE = Variant("large", Farm, parameters={"fields": 3, "price": 2}, points=POINTS)
DEAR = replace(LARGE, name="dear", plugins=[(dearer, HARVEST, "after")], policies={HARVEST: RULE})


def test_envs_accept_a_variant_like_a_simulation():
    assert simulate(LARGE).log == [("wheat", 2)] * 3
    assert simulate(DEAR).log == [("wheat", 20)] * 3
    assert simulate(DEAR, {"sower_0": five}).log == [(5, 20)] * 3
    for env in (aec_env(DEAR), generate_env(DEAR, view="aec")()):
        assert env.possible_agents == ["sower_0"]
        play(env, 4)
        assert env.simulation.log == [(4, 20)] * 3
    assert single_env(DEAR).reset()[0].tolist() == [1.0, 2.0]
    assert set(joint_env(LARGE).action_space.spaces) == {"sower_0", "reaper_0"}
    assert simulate(Variant("instance", Farm(1), points=POINTS)).log == [("wheat", 1)]
    assert simulate(
        Variant("factory", lambda fields: Farm(fields), parameters={"fields": 1})
    ).log == [("wheat", 1)]
    assert Farm().sow(0) == "wheat"  # and the model is what it was


def test_env_arguments_override_or_extend_the_fields_of_a_variant():
    assert simulate(DEAR, {HARVEST: five}).log == [("wheat", 50)] * 3
    assert simulate(DEAR, plugins=[(dearer, HARVEST, "after")]).log == [("wheat", 200)] * 3
    limited = replace(DEAR, options={"max_steps": 1})
    env = aec_env(limited, {SOW: define(agent="someone")}, policies={HARVEST: RULE})
    assert env.possible_agents == ["someone"]
    assert [turn.truncated for turn in play(env, 1)] == [False, True]
    assert len(play(aec_env(limited, max_steps=2), 1)) == 3


def test_variant_is_frozen_and_can_be_pickled():
    with pytest.raises(FrozenInstanceError):
        LARGE.name = "larger"
    given = {"fields": 1}
    plugins = ((dearer, HARVEST, "after"),)
    variant = Variant(
        "small", Farm, parameters=given, plugins=plugins, points={Farm.sow: POINTS[SOW]}
    )
    given["fields"] = 7
    env = aec_env(variant)
    env.reset()  # now hooks stand in the places of the functions
    again = pickle.loads(cloudpickle.dumps(variant))
    env.close()
    assert (again.name, again.simulation, again.plugins, list(again.points)) == (
        "small",
        Farm,
        plugins,
        [SOW],
    )
    for each in (variant, again):
        assert simulate(each, points=POINTS).log == [("wheat", 10)]
    plain = pickle.loads(pickle.dumps(replace(DEAR, points=None)))  # also without cloudpickle
    assert plain.parameters == LARGE.parameters


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"name": ""}, OptionValueError, "name"),
        ({"parameters": {"acres": 3}}, SimulationError, "acres"),
        ({"parameters": 3}, OptionValueError, "parameters"),
        (
            {"simulation": Farm(), "parameters": {"fields": 3}},
            SimulationError,
            "class or a factory",
        ),
        ({"simulation": DEAR}, SimulationError, "replace"),
        ({"options": {"plugins": []}}, OptionValueError, "plugins"),
        ({"options": {"speed": 3}}, UnknownOptionError, "speed"),
        ({"policies": {"nobody": five}}, UnknownPointError, "nobody"),
        ({"plugins": [(dearer, HARVEST, "between")]}, HandlerError, "between"),
    ],
)
def test_variant_refuses_invalid_fields(changes, error, message):
    with pytest.raises(error, match=message):
        aec_env(replace(LARGE, **changes))


def test_env_provenance_lists_the_parts_of_an_env():
    env = aec_env(DEAR, max_steps=np.int64(9), policies={HARVEST: five})
    assert env.provenance()["seed"] is None
    env.reset(seed=3)
    said = json.loads(json.dumps(env.provenance()))
    assert said == {
        "simulation": f"{__name__}.Farm",
        "packages": {"tests": None},
        "variant": "dear",
        "parameters": {"fields": 3, "price": 2},
        "points": {SOW: "sower_0"},
        "plugins": [{"handler": f"{__name__}.dearer", "target": HARVEST, "position": "after"}],
        "policies": {HARVEST: f"{__name__}.five"},
        "options": {"max_steps": 9},
        "seed": 3,
        "python": said["python"],
        "dependencies": said["dependencies"],
    }
    assert said["dependencies"]["numpy"] == np.__version__
    assert said["dependencies"]["simenv-marl"] == version("simenv-marl")
    assert provenance(DEAR, seed=3, max_steps=9, policies={HARVEST: five}) == said


def test_env_provenance_has_the_versions_of_the_models_packages():
    move, untold = (
        "mesa.examples.advanced.wolf_sheep.agents.Wolf.move",
        "typing_extensions.reveal_type",
    )
    said = provenance(Farm, {move: define(agent=str), untold: define(agent="one")})
    versions = {package: version(package) for package in ("mesa", "typing_extensions")}
    assert said["packages"] == versions | {"tests": None}
    assert said["points"] == {move: None, untold: "one"}
    assert said["variant"] is None


def test_env_provenance_writes_values_that_are_no_json_as_text():
    ant = decision(agent="ant_0")
    parameters = {
        "a": np.arange(2), "b": {1.5}, "c": Farm, "d": {1: {Farm: 2, (3, None): 4}},
        "e": [np.datetime64("2020-01-01"), np.complex64(1)], "f": np.array([1, 2j], object),
        "g": np.longdouble(1),
    }  # fmt: skip
    variant = Variant("odd", lambda **parameters: Farm(), parameters=parameters, points=ant)
    said = json.loads(json.dumps(provenance(variant)))
    assert isinstance(said["parameters"].pop("g"), (str, float))  # it has no counterpart everywhere
    assert said["parameters"] == {
        "a": [0, 1], "b": ["1.5"], "c": f"{__name__}.Farm",
        "d": {"1": {f"{__name__}.Farm": 2, "[3, None]": 4}},
        "e": ["datetime.date(2020, 1, 1)", "(1+0j)"], "f": [1, "2j"],
    }  # fmt: skip
    assert "<lambda>" in said["simulation"]
