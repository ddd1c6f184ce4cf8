"""Functions that are defined again: by a reload, or by a cell of a notebook that runs again."""

import importlib
import sys
import types
from functools import partial

import pytest

from simenv_marl import aec_env
from simenv_marl.errors import NoDecisionError, PatchError
from simenv_marl.hooks.hook import hook_of
from simenv_marl.plugins import expose_to_plugins
from tests.worlds.models import calling, define, play

HEAD = """
from tests.worlds.models import define

class Sim:
    def reset(self):
        self.log = []

    def run(self):
        self.log += [Tank().drain(), Tank().heat(), Kid().drain(), choose(), pick()]
"""
MODEL = """
class Tank:
    def drain(self):
        return "rule"

    @define()
    def heat(self):
        return "rule"

class Kid(Tank):
    pass

def choose():
    return "rule"

@define()
def pick():
    return "rule"
"""
NAMES = ("Tank.drain", "Tank.heat", "choose", "pick")


@pytest.fixture
def model(monkeypatch):
    """A module whose code runs again on demand, as reloads and cells do."""
    module = types.ModuleType("reloaded_model")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(HEAD + MODEL, vars(module))
    return module


def points_of(model, *names):
    return {f"{model.__name__}.{name}": define() for name in names}


def log_of(env):
    play(env, 3)
    return env.simulation.log


def test_new_env_uses_redefined_model_functions(model):
    old = aec_env(model.Sim, points_of(model, *NAMES))
    assert log_of(old) == [3] * 5
    exec(MODEL, vars(model))
    assert log_of(aec_env(model.Sim, points_of(model, *NAMES))) == [3] * 5
    kid = aec_env(model.Sim, points_of(model, "Kid.drain"))
    assert log_of(kid) == ["rule", "rule", 3, "rule", "rule"]
    decorated = aec_env(model.Sim, {model.Tank.heat: None, model.pick: define()})
    assert log_of(decorated) == ["rule", 3, "rule", "rule", 3]
    old.close()
    assert [model.Tank().drain(), model.choose()] == ["rule", "rule"]


@pytest.mark.parametrize("name", [*NAMES, "Kid.drain"])
def test_env_warns_if_its_model_functions_were_defined_again(model, name):
    env = aec_env(model.Sim, points_of(model, name))
    env.reset()
    exec(MODEL, vars(model))
    again = pytest.warns(UserWarning, match=rf"defined again.*{name}\. Calls")
    with again, pytest.raises(NoDecisionError):
        env.reset()
    with pytest.raises(NoDecisionError):
        env.reset()  # it has warned once


@pytest.mark.parametrize("name", NAMES)
def test_env_warns_of_an_outdated_function_as_a_key_of_points(model, name):
    owner, _, attribute = name.rpartition(".")
    points = {getattr(getattr(model, owner, model), attribute): define()}
    alive = model.Tank
    exec(MODEL, vars(model))
    assert alive is not model.Tank
    if name == "choose":
        with pytest.raises(PatchError, match="name its new definition"):
            aec_env(model.Sim, points)
        return
    with pytest.warns(UserWarning, match="defined again"), pytest.raises(NoDecisionError):
        aec_env(model.Sim, points).reset()


def test_decision_points_missing_after_a_redefinition_are_unregistered(model, monkeypatch):
    monkeypatch.setattr("simenv_marl.decision.hooks", lambda: [*map(hook_of, decorated)])
    decorated = [model.Tank.heat, model.pick]
    alive = aec_env(model.Sim)
    assert alive.possible_agents == ["heat_0", "pick_0"]
    exec(MODEL.replace("heat", "cool"), vars(model))
    decorated += [model.Tank.cool, model.pick]
    assert aec_env(model.Sim).possible_agents == ["cool_0", "pick_0"]
    exec(MODEL.replace("@define()", ""), vars(model))
    exec("pick = define(agent='picker')(pick)", vars(model))
    decorated.append(model.pick)
    assert aec_env(model.Sim).possible_agents == ["picker"]


def test_env_does_not_warn_of_redefined_plugin_targets_without_a_function(model):
    largest = expose_to_plugins(partial(max, 3))
    calls = []
    plugin = (lambda *args: calls.append(args), largest, "before")
    env = aec_env(
        calling(lambda: model.choose(), lambda: largest(2)),
        {model.choose: define()},
        plugins=[plugin],
    )
    assert log_of(env) == [3, 3]
    assert calls == [(2,)]


def test_make_step_can_decorate_the_same_method_again(model):
    for number in range(3):
        model.Tank.drain = define(agent=f"tank {number}")(model.Tank.drain)
        env = aec_env(model.Sim, model.Tank.drain)
        assert env.possible_agents == [f"tank {number}"]
        assert log_of(env)[0] == 3


def test_new_env_uses_a_reloaded_model_module(tmp_path, monkeypatch):
    (tmp_path / "reloaded_file.py").write_text(HEAD + MODEL, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "reloaded_file", None)  # so the module is removed at the end
    del sys.modules["reloaded_file"]
    module = importlib.import_module("reloaded_file")
    points = points_of(module, *NAMES)
    assert log_of(aec_env(module.Sim, points)) == [3] * 5
    assert log_of(aec_env(importlib.reload(module).Sim, points)) == [3] * 5
