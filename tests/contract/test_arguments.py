"""Mappings take as many of a call's arguments as they want."""

import functools

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import SimulationInterface, aec_env, make_step, single_env
from simenv_marl.errors import DefinitionError
from tests.worlds.models import begun, define

TANK = f"{__name__}.Tank.fill"
OPEN = f"{__name__}.Tank.mix"


class Tank:
    def fill(self, level, rain=2.0, /, *, price, season="dry"):
        return level

    def mix(self, level, *more, **named):
        return level


class Plant(SimulationInterface):
    def reset(self, seed=None):
        self.tank = Tank()
        self.log = []

    def run(self):
        self.log.append(self.tank.fill(1.0, price=3.0))
        self.log.append(self.tank.mix(5.0, 6.0, 7.0, flow=8.0))


def seen(mapping, point=TANK, **changes):
    """Return the arguments with which a mapping is called."""
    calls = []

    @functools.wraps(mapping)
    def observe(*args, **kwargs):
        value = mapping(*args, **kwargs)
        calls.append(value)
        return [0.0, 0.0]

    env = begun(single_env(Plant, {point: define(observation_space_mapping=observe, **changes)}), 1)
    env.close()
    return calls[0]


@pytest.mark.parametrize(
    ("mapping", "expected"),
    [
        (lambda: "nothing", "nothing"),
        (lambda tank: type(tank), Tank),
        (lambda tank, level: level, 1.0),
        (lambda tank, level, rain: (level, rain), (1.0, 2.0)),
        (lambda *args: args[1:], (1.0, 2.0)),
        (lambda tank, *rest: rest, (1.0, 2.0)),
        (lambda *, level: level, 1.0),
        (lambda *, price, rain: (price, rain), (3.0, 2.0)),
        (lambda tank, *, season: season, "dry"),
        (lambda tank, **named: named, {"price": 3.0, "season": "dry"}),
        (lambda *args, **named: (args[1:], named), ((1.0, 2.0), {"price": 3.0, "season": "dry"})),
        (lambda tank, i=7: i, 7),
        (lambda tank, level=7: level, 1.0),
        (lambda tank, i=7, rain=8: (i, rain), (7, 2.0)),
        (lambda tank, *, i=7, price: (i, price), (7, 3.0)),
        (lambda tank, level, /: level, 1.0),
        (lambda tank, i=7, /: i, 1.0),
        (functools.partial(lambda unit, tank, level: (unit, level), "m"), ("m", 1.0)),
        (lambda tank, *, _simulation: type(_simulation), Plant),
    ],
)
def test_mapping_gets_only_the_arguments_that_it_takes(mapping, expected):
    assert seen(mapping) == expected


@pytest.mark.parametrize(
    ("mapping", "expected"),
    [
        (lambda tank, level, first: first, 6.0),
        (lambda tank, level, *more: more, (6.0, 7.0)),
        (lambda tank, *, flow: flow, 8.0),
        (lambda tank, **named: named, {"flow": 8.0}),
    ],
)
def test_mapping_gets_all_arguments_of_a_decision_with_args_and_kwargs(mapping, expected):
    assert seen(mapping, OPEN) == expected


@pytest.mark.parametrize(
    "part",
    [
        "observation_space_mapping",
        "reward_mapping",
        "action_mask_mapping",
        "agent",
        "action_labels",
    ],
)
@pytest.mark.parametrize(
    "mapping", [lambda a, b, c, d: None, lambda tank, *, colour: None], ids=["places", "names"]
)
def test_env_refuses_a_mapping_with_more_parameters_than_the_decision(part, mapping):
    with pytest.raises(DefinitionError) as caught:
        aec_env(Plant, {TANK: define(**{part: mapping})})
    text = str(caught.value)
    assert part in text
    assert "price" in text  # the signature of the decision function
    assert ("a, b, c, d" in text) or ("colour" in text)


def test_missing_argument_of_a_decision_with_args_is_raised_by_reset():
    env = single_env(Plant, {OPEN: define(reward_mapping=lambda a, b, c, d, e: 0.0)})
    with pytest.raises(TypeError):
        env.reset(seed=1)


class Ward(SimulationInterface):
    """Decides for two patients at once."""

    def reset(self, seed=None):
        self.log = []

    def treat(self, patients, hour):
        return [0 for _ in patients]

    def run(self):
        self.log.append(self.treat(["ada", "bob"], 5))


def test_mapping_gets_action_and_split_item_before_other_arguments():
    env = begun(
        aec_env(
            Ward,
            {
                f"{__name__}.Ward.treat": make_step(
                    observation_space=spaces.Discrete(100),
                    observation_space_mapping=lambda patient, ward, patients, hour: hour,
                    action_space=spaces.Discrete(3),
                    apply=lambda action, patient, *, hour: (action, patient, hour),
                    reward_mapping=lambda patient: 0.0,
                    split=lambda ward, patients: patients,
                    gather=lambda patients, decisions: dict(zip(patients, decisions, strict=True)),
                    agent=lambda patient: patient,
                )
            },
        ),
        1,
    )
    assert env.last()[0] == 5
    env.step(1)
    env.step(2)
    assert env.simulation.log == [{"ada": (1, "ada", 5), "bob": (2, "bob", 5)}]


def test_builtin_as_a_mapping_gets_all_arguments():
    env = begun(
        single_env(
            Plant,
            {
                TANK: define(
                    observation_space=spaces.Box(0, 9, (1,), np.float64),
                    observation_space_mapping=lambda tank, level: [level],
                    rule_action_mapping=int,
                )
            },
        ),
        1,
    )
    assert env.step(1)[2]
