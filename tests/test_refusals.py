"""Mistakes of users: reported when an environment is made, or with a remedy; and ``help``."""

import pydoc
from dataclasses import fields
from queue import SimpleQueue
from threading import Thread

import pytest
from gymnasium import spaces

import simenv_marl
from simenv_marl import SimulationInterface, aec_env, generate_env, parallel_env, single_env
from simenv_marl.core.plans.options import CheckOptions, EpisodeOptions, Options, ViewOptions
from simenv_marl.errors import (
    AgentError,
    DefinitionError,
    NoDecisionError,
    UnknownOptionError,
    ViewError,
    did_you_mean,
)
from tests.processes import run_code
from tests.worlds.copied import Walk
from tests.worlds.models import define


class Model(SimulationInterface):
    def reset(self):
        pass

    def run(self):
        self.choose()

    def choose(self):
        return 0

    def tell(self):
        return 0


class Derived(Model):
    """Overrides what a point of the base class names."""

    def choose(self):
        return 1


CHOOSE = f"{__name__}.Model.choose"
TELL = f"{__name__}.Model.tell"


@pytest.mark.parametrize(
    ("view", "part", "space", "match"),
    [
        ("turn", "observation", spaces.Sequence(spaces.Discrete(2)), f"the space of {TELL},"),
        ("turn", "action", spaces.Box(0, float("inf")), f"finite.*the space of {TELL},"),
        ("turn", "action", spaces.MultiBinary(2), f"a Box, not .*the space of {TELL},"),
        ("joint", "action", spaces.MultiBinary(2), r"not MultiBinary\(2\) of 'tell_0'"),
    ],
)
def test_env_error_names_the_decision_point_whose_space_does_not_fit(view, part, space, match):
    points = {CHOOSE: define(), TELL: define(**{f"{part}_space": space})}
    with pytest.raises(ViewError, match=match):
        generate_env(Model, points, view=view, flatten=True)()


def test_agent_option_is_refused_except_in_single_env():
    points = {CHOOSE: define(agent=lambda model: "a"), TELL: define(agent=lambda model: "b")}
    with pytest.raises(AgentError, match="other views take no agent="):
        generate_env(Model, points, view="turn", agent="a")
    with pytest.raises(UnknownOptionError, match=r"the single view only; .*policies="):
        generate_env(Model, {CHOOSE: define()}, view="turn", agent="choose_0")


@pytest.mark.parametrize(
    "part", ["observation_space_mapping", "reward_mapping", "agent", "action_mask_mapping"]
)
def test_env_refuses_a_mapping_with_a_positional_simulation_parameter(part):
    def mapping(model, _simulation=None):
        return 0

    with pytest.raises(
        DefinitionError,
        match=r"_simulation of .*mapping.* must be keyword-only: write it behind a \*",
    ):
        aec_env(Model, {CHOOSE: define(**{part: mapping})})


@pytest.mark.filterwarnings("ignore:.* override")
def test_no_decision_error_names_subclass_methods_that_hide_the_decision():
    env = single_env(Derived, {CHOOSE: define()})
    with pytest.raises(
        NoDecisionError, match=rf"{CHOOSE}; .* called instead.*{__name__}\.Derived\.choose"
    ):
        env.reset()


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_env_possible_agents_error_says_how_to_declare_them(make):
    env = make(Model, {CHOOSE: define(agent=lambda model: "ant")})
    assert not hasattr(env, "possible_agents")
    with pytest.raises(AttributeError, match="declare them with the option possible_agents="):
        print(env.possible_agents)
    with pytest.raises(AttributeError, match="no attribute 'posible_agents'"):
        print(env.posible_agents)


def test_env_error_names_the_thread_that_decides_too_late():
    calls, answers = SimpleQueue(), SimpleQueue()
    middleware = Thread(
        target=lambda: [answers.put(call()) for call in iter(calls.get, None)], name="middleware"
    )

    class Served(Model):
        def run(self):
            calls.put(self.choose)
            assert answers.get(timeout=10) == 0

    middleware.start()
    env = single_env(Served, {f"{__name__}.Model.choose": define()})
    try:
        with pytest.raises(
            NoDecisionError, match=rf"{CHOOSE}; .*threads that are not the simulation's: middleware"
        ):
            env.reset()
    finally:
        calls.put(None)
        middleware.join()


# -- hints and help -------------------------------------------------------------------------------

MAKERS = ("aec_env", "parallel_env", "single_env", "joint_env", "vector_env", "generate_env")
OPTIONS = {field.name for field in fields(Options)}


def test_type_checkers_know_the_options_of_envs():
    assert set(ViewOptions.__annotations__) == OPTIONS
    views = {"policies", "record", "record_all", "step_timeout"}
    assert set(EpisodeOptions.__annotations__) == OPTIONS - views
    assert set(CheckOptions.__annotations__) == OPTIONS - {"max_steps"}


@pytest.mark.parametrize("name", MAKERS)
def test_help_of_envs_explains_every_option(name):
    text = pydoc.plain(pydoc.render_doc(getattr(simenv_marl, name)))
    for option in OPTIONS:
        assert f"- ``{option}``: " in text
    assert "{options}" not in text
    assert text.rstrip().count("Raises:") == 1


def test_error_hints_name_the_closest_existing_names():
    assert (
        did_you_mean("sheep_1", ["sheep_0", "sheep_2", "wolf_0"])
        == "; did you mean sheep_2 or sheep_0?"
    )
    assert did_you_mean("quite different", ["max_steps"]) == did_you_mean(3, ["3"]) == ""


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        (lambda env: aec_env(Model, {f"{__name__}.Model.chose": define()}), r".*Model\.choose"),
        (lambda env: aec_env(Model, {f"{__name__}.Modle.choose": define()}), rf"{__name__}\.Model"),
        (lambda env: aec_env(Walk, Walk.choose, max_step=3), "max_steps"),
        (lambda env: single_env(Walk, Walk.choose, agent="walker"), "walker_0"),
        (lambda env: simenv_marl.generate_env(Walk, Walk.choose, view="paralel"), "parallel"),
        (lambda env: env.observe("walker_1"), "walker_0"),
        (lambda env: simenv_marl.branch(env, 1, method="frok"), "fork"),
        (
            lambda env: simenv_marl.experiments.design({"a": [1, 2]}, "full_factorail"),
            "full_factorial",
        ),
    ],
)
def test_error_messages_suggest_the_name_that_was_meant(wrong, hint):
    env = aec_env(Walk, Walk.choose)
    env.reset(seed=1)
    with pytest.raises(simenv_marl.SimEnvError, match=f"did you mean {hint}"):
        wrong(env)


def test_import_error_of_a_moved_name_says_which_module_has_it():
    expected = "pad_agents is in simenv_marl.envs: from simenv_marl.envs import pad_agents"
    with pytest.raises(AttributeError, match=expected):
        print(simenv_marl.pad_agents)
    assert not hasattr(simenv_marl, "pad_agents")
    with pytest.raises(ImportError, match=expected):
        exec("from simenv_marl import pad_agents")
    with pytest.raises(ImportError, match="cannot import name 'nothing'"):
        exec("from simenv_marl import nothing")
    exec("from simenv_marl import envs, plugins, registration")


def test_importing_the_library_refuses_a_free_threaded_python():
    shown = run_code(
        """
        import sysconfig
        sysconfig.get_config_vars()["Py_GIL_DISABLED"] = 1
        try:
            import simenv_marl
        except ImportError as error:
            print(error)
        """
    )
    assert "simenv_marl needs a Python with the global interpreter lock" in shown
