"""Co-simulation units (FMI 2 and 3): the master decides in this process, the units run below it."""

import random
import shutil
from functools import cache

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, clone, evaluate, single_env

pytest.importorskip("fmpy", reason="FMPy is not there: pip install 'simenv-marl[fmi]'")

from examples.heated_room import train
from examples.heated_room.env import BOUNDS, OBSERVED, RoomSim
from examples.heated_room.master import labels_of, spaces_of
from examples.heated_room.units import UNITS, unit
from fmpy import read_model_description
from fmpy.model_description import Dimension, Item, ModelDescription, ModelVariable, SimpleType

NEEDS_C = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
KINDS = pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[NEEDS_C] if kind == "c" else []) for kind in UNITS]
)


@cache
def plain(kind, seed):
    """The cost and the temperature at the end of the model's own run."""
    simulation = RoomSim(kind)
    simulation.reset(seed)
    simulation.run()
    found = outcome(simulation)
    simulation.close()
    return found


def outcome(simulation):
    return simulation.room.cost, simulation.room.read("temperature")


def heat(power):
    return {"power": np.array([power])}


@KINDS
def test_fmi_interleaved_episodes_match_runs_without_env(make_env, kind):
    seeds, steps = (3, 4, 3), 192
    envs = [make_env(single_env, RoomSim(kind)) for _ in seeds]
    for env, seed in zip(envs, seeds, strict=True):
        env.reset(seed=9)
        for _ in range(50):
            env.step(heat(2.0))
        env.reset(seed=seed)
    earned, ends = dict.fromkeys(envs, 0.0), []
    for env in random.Random(0).sample(envs * steps, len(envs) * steps):
        _, reward, terminated, truncated, _ = env.step(RULE)
        earned[env] += reward
        ends += [(terminated, truncated)] if terminated or truncated else []
    assert [outcome(env.simulation) for env in envs] == [plain(kind, seed) for seed in seeds]
    assert [*earned.values()] == pytest.approx([-plain(kind, seed)[0] for seed in seeds])
    assert ends == [(False, True)] * 3, "a time limit ends them"


@NEEDS_C
def test_fmi_2_fmi_3_and_c_models_give_the_same_results():
    assert plain("fmi2", 3) == plain("fmi3", 3) == pytest.approx(plain("c", 3), rel=1e-12)


@pytest.mark.greenlet("with threads there is no fork")
@KINDS
@pytest.mark.parametrize("method", ["fork", "replay"])
def test_fmi_clone_continues_exactly_even_if_the_unit_has_no_states(make_env, kind, method):
    env = make_env(single_env, RoomSim(kind))
    env.reset(seed=5)
    powers = np.random.default_rng(0).uniform(0.0, 2.0, 192)
    for power in powers[:60]:
        env.step(heat(power))
    copies = [make_env(clone, env, method=method, seed=seed) for seed in (None, 7)]

    def rest(env):
        return [str(env.step(heat(power))) for power in powers[60:]]

    found = rest(env)
    assert rest(copies[0]) == found
    assert rest(copies[1]) != found, "another weather"


@pytest.mark.greenlet("the driver makes no difference to the spaces")
@KINDS
def test_fmi_spaces_take_bounds_from_the_variable_its_type_or_the_user(kind):
    description = read_model_description(unit(kind))
    names = ("power", *OBSERVED)
    if kind == "fmi2":
        with pytest.raises(
            ValueError, match=r"power has no bounds; give them: bounds=\{'power': \(low, high\)\}"
        ):
            spaces_of(description, names)
        found = spaces_of(description, names, BOUNDS)
        assert labels_of(description, names)["power"] == "power"
    else:
        found = spaces_of(description, names)
        assert labels_of(description, names) == {
            "power": "power (kW)", "temperature": "temperature (degC)", "outside": "outside (degC)"
        }  # fmt: skip
    assert found["power"] == spaces.Box(0.0, 2.0, (1,), np.float64)
    assert found["outside"] == spaces.Box(-40.0, 60.0, (1,), np.float64)
    assert spaces_of(description, ["power"], {"power": (0.5, 1.5)})["power"].low == 0.5
    with pytest.raises(ValueError, match=r"no variable heat, but .*power"):
        spaces_of(description, ["heat"])


@pytest.mark.greenlet("the driver makes no difference to the spaces")
def test_fmi_variables_that_are_not_real_have_discrete_spaces():
    level = SimpleType(
        name="Level", type="Enumeration", items=[Item(name="low", value="1"), Item("high", "2")]
    )
    variables = [
        ModelVariable(name="open", valueReference=0, type="Boolean"),
        ModelVariable(name="level", valueReference=1, type="Enumeration", declaredType=level),
        ModelVariable(name="count", valueReference=2, type="Int32", min="-1", max="3"),
        ModelVariable(name="text", valueReference=3, type="String"),
        ModelVariable(
            name="row",
            valueReference=4,
            type="Float64",
            min="0",
            max="1",
            dimensions=[Dimension("2", 0)],
        ),
    ]
    description = ModelDescription(modelVariables=variables)
    found = spaces_of(description, ["open", "level", "count"])
    assert dict(found) == {
        "open": spaces.Discrete(2),
        "level": spaces.Discrete(2, start=1),
        "count": spaces.Discrete(5, start=-1),
    }
    for name in ("text", "row"):
        with pytest.raises(ValueError, match=f"{name} is not a scalar number"):
            spaces_of(description, [name], {name: (0, 1)})


@pytest.mark.greenlet("the driver makes no difference to learning")
@NEEDS_C
def test_fmi_heater_learns_to_beat_the_thermostat(capsys):
    train.main(["--generations", "1", "--seeds", "2"])
    assert "Evaluation: rule, trained on 2 seeds" in capsys.readouterr().out
    contenders = {
        "rule": {},
        "trained": {"heater_0": train.learn(generations=8, episodes=1)},
        "untrained": {"heater_0": train.Linear([0.0] * 6)},
    }
    values = evaluate(RoomSim, contenders, seeds=range(10**6, 10**6 + 8)).values()
    assert (values["untrained"] < values["rule"]).all()
    assert (values["trained"] > values["rule"]).all()
