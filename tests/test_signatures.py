"""What editors and ``help`` show: typed signatures, all options from one source, and hints about wrong names."""

import inspect
import pydoc
from dataclasses import fields

import pytest

import simenv_marl
from simenv_marl.core.options import CheckOptions, EpisodeOptions, Options, ViewOptions
from simenv_marl.errors import did_you_mean
from tests.worlds.copied import Walk

MAKERS = ("aec_env", "parallel_env", "single_env", "joint_env", "vector_env", "generate_env")
OPTIONS = {field.name for field in fields(Options)}


def test_type_checkers_know_the_options_that_there_are():
    assert set(ViewOptions.__annotations__) == OPTIONS
    assert set(EpisodeOptions.__annotations__) == OPTIONS - {"policies"}
    assert set(CheckOptions.__annotations__) == OPTIONS - {"max_steps"}


@pytest.mark.parametrize("name", MAKERS)
def test_help_explains_every_option(name):
    text = pydoc.plain(pydoc.render_doc(getattr(simenv_marl, name)))
    for option in OPTIONS:
        assert f"- ``{option}``: " in text
    assert "{options}" not in text
    assert text.rstrip().count("Raises:") == 1


@pytest.mark.parametrize("name", simenv_marl.__all__)
def test_no_public_signature_is_a_string(name):
    thing = getattr(simenv_marl, name)
    if not callable(thing) or (inspect.isclass(thing) and issubclass(thing, BaseException)):
        return
    signature = inspect.signature(thing)
    for annotation in (signature.return_annotation, *(own.annotation for own in signature.parameters.values())):
        # what pandas and Matplotlib would have to be imported for is the exception
        assert not isinstance(annotation, str) or any(word in annotation for word in ("DataFrame", "Figure", "Axes"))


def test_help_begins_with_what_the_library_is():
    first, *_ = inspect.getdoc(simenv_marl).splitlines()
    assert "reinforcement learning" in first.lower()
    assert "simulation" in first


@pytest.mark.parametrize(
    ("name", "known", "hint"),
    [
        ("max_step", ["max_steps", "agent"], "; did you mean max_steps?"),
        ("sheep_1", ["sheep_0", "sheep_2", "wolf_0"], "; did you mean sheep_2 or sheep_0?"),
        ("quite different", ["max_steps"], ""),
        (3, ["3"], ""),
        (None, ["None"], ""),
    ],
)
def test_hints_name_what_is_close(name, known, hint):
    assert did_you_mean(name, known) == hint


def evaluation(**options):
    pytest.importorskip("scipy")
    return simenv_marl.evaluate(Walk, {"rule": {}}, seeds=range(2), points=Walk.choose, **options)


def environment():
    made = simenv_marl.aec_env(Walk, Walk.choose)
    made.reset(seed=1)
    return made


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        (lambda: simenv_marl.aec_env(Walk, Walk.choose, max_step=3), "max_steps"),
        (lambda: simenv_marl.single_env(Walk, Walk.choose, agent="walker"), "walker_0"),
        (lambda: simenv_marl.generate_env(Walk, Walk.choose, view="paralel"), "parallel"),
        (lambda: environment().observe("walker_1"), "walker_0"),
        (lambda: simenv_marl.branch(environment(), 1, method="frok"), "fork"),
        (lambda: simenv_marl.experiments.design({"a": [1, 2]}, "full_factorail"), "full_factorial"),
        (lambda: evaluation().summary("retrun"), "return"),
        (lambda: evaluation(baseline="rul"), "rule"),
    ],
)
def test_messages_hint_at_the_name_that_was_meant(wrong, hint):
    with pytest.raises(simenv_marl.SimEnvError, match=f"did you mean {hint}"):
        wrong()
