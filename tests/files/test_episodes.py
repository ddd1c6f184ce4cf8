"""Episodes are saved and loaded: the same decision, and the same continuation."""

import json
import os

import numpy as np
import pytest

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    clone,
    joint_env,
    load_episode,
    parallel_env,
    reseed_generators,
    save_episode,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.errors import (
    EpisodeFileError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    StoreError,
    ViewError,
)
from simenv_marl.planning import RolloutPolicy
from tests.processes import python
from tests.worlds import saved
from tests.worlds.random_worlds import YARD_POINTS, yard_outcome
from tests.worlds.saved import YARD, Pumps, differing, future, mid_episode, steady


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


# -- continuations --------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_saved_episodes_of_random_models_continue_alike_in_a_fresh_process():
    assert differing(80) == []


@pytest.mark.parametrize("kind", ["saved", "branches"])
def test_command_of_saved_worlds_prints_how_many_continuations_differ(kind):
    assert python("-m", "tests.worlds.saved", 1, kind).stdout.startswith("0 of ")


@pytest.mark.parametrize("make", [aec_env, parallel_env, turn_env])
@pytest.mark.parametrize("method", ["fork", "replay"])
def test_save_episode_of_a_clone_equals_that_of_its_original(make, method, tmp_path):
    env = mid_episode(make)
    with_seed = clone(env, method=method)
    for path, each in ((tmp_path / "env", env), (tmp_path / "clone", with_seed)):
        save_episode(each, path)
    assert (tmp_path / "env").read_text() == (tmp_path / "clone").read_text()
    loaded = load_episode(tmp_path / "clone")
    assert future(loaded, 3) == future(env, 3)
    assert yard_outcome(loaded.unwrapped.simulation) == yard_outcome(env.unwrapped.simulation)


class Reseeded(Pumps):
    """Pumps whose future can be drawn anew."""

    def reseed(self, seed):
        reseed_generators(self, seed)


def test_save_episode_of_a_reseeded_clone_keeps_its_seed(tmp_path):
    env = mid_episode(single_env, Reseeded, agent="push", taken=3, points=None)
    other = clone(env, seed=5)
    other.step(RULE)
    save_episode(other, tmp_path / "a")
    assert {"reseed": 5} in lines_of(tmp_path / "a")
    assert future(load_episode(tmp_path / "a"), 1) == future(other, 1)


def test_save_episode_works_in_a_branch(tmp_path):
    env = mid_episode()

    def save(continuation, number):
        continuation.step(RULE)
        save_episode(continuation, tmp_path / "branch")
        return repr(continuation.last())

    [told] = branch(env, save)
    assert repr(load_episode(tmp_path / "branch").last()) == told


def test_load_episode_restores_policies_for_later_decisions(tmp_path):
    env = mid_episode(single_env, Pumps, points=None, agent="push", policies={"pull": steady})
    save_episode(env, tmp_path / "a")
    assert [line.get("by") for line in lines_of(tmp_path / "a")[1:4]] == [None, "policy", None]
    loaded = load_episode(tmp_path / "a")
    assert loaded.unwrapped.provenance()["policies"] == {"pull": f"{saved.__name__}.steady"}
    assert future(loaded, 2) == future(env, 2)


def test_episode_file_contains_the_steps_of_ended_agents(tmp_path):
    env = aec_env(Pumps, max_steps=3)
    env.reset(seed=1)
    for _ in range(3):
        env.step(RULE)
    env.step(None)
    save_episode(env, tmp_path / "a")
    assert lines_of(tmp_path / "a")[-2:] == [{"exit": "push"}, {"end": "truncated"}]
    loaded = load_episode(tmp_path / "a")
    assert (loaded.agents, repr(loaded.latest)) == (env.agents, repr(env.last()))
    env.step(None)
    save_episode(env, tmp_path / "a")
    assert load_episode(tmp_path / "a").agents == []


@pytest.mark.parametrize("make", [single_env, joint_env, turn_env, parallel_env])
def test_env_latest_is_the_result_of_the_last_reset_or_step(make, tmp_path):
    options = {"agent": "push"} if make is single_env else {}
    env = make(Pumps, **options)
    with pytest.raises(NotResetError):
        _ = env.unwrapped.latest
    results = env.reset(seed=2)
    assert env.unwrapped.latest is results
    save_episode(env, tmp_path / "a")
    assert repr(load_episode(tmp_path / "a").unwrapped.latest) == repr(results)
    action = {"push": RULE, "pull": RULE} if make in (joint_env, parallel_env) else RULE
    results = env.step(action)
    assert env.unwrapped.latest is results
    assert repr(clone(env).unwrapped.latest) == repr(results)
    save_episode(env, tmp_path / "a")
    assert repr(load_episode(tmp_path / "a").unwrapped.latest) == repr(results)


def test_episode_files_store_plugins_by_name(tmp_path):
    env = mid_episode(plugins=[(twice, f"{POINTS_OF}.Yard.plan", "after")])
    save_episode(env, tmp_path / "a")
    loaded = load_episode(tmp_path / "a")
    assert loaded.unwrapped.plugins == env.unwrapped.plugins
    assert future(loaded, 3) == future(env, 3)


POINTS_OF = "tests.worlds.random_worlds"


def twice(yard, _result):
    """A handler."""


def test_episode_files_store_float32_actions_exactly(tmp_path):
    env = mid_episode(single_env, Pumps, points=None, agent="push", taken=0)
    env.step(np.array([0.1, -1 / 3], np.float32))
    env.step(np.array([1, 0], np.float32))
    save_episode(env, tmp_path / "a")
    assert future(load_episode(tmp_path / "a"), 3) == future(env, 3)
    decisions = lines_of(tmp_path / "a")[1:3]
    assert [line["action"]["dtype"] for line in decisions] == ["<f4", "<f4"]


def test_episode_file_is_small(tmp_path):
    env = mid_episode(taken=0)
    for _ in range(30):
        env.step(None if env.terminations[env.agent_selection] else 3)
    save_episode(env, tmp_path / "a")
    head, *lines = (tmp_path / "a").read_bytes().splitlines()
    assert len(head) < 1024
    assert max(map(len, lines)) < 200


# -- refusals, when it is saved --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        ({"policies": {"planner": lambda observation: 1}}, "policies= of 'planner'"),
        ({"team_reward": lambda yard: 0.0}, "team_reward="),
        ({"plugins": [(lambda *_, **__: None, f"{POINTS_OF}.Yard.plan", "before")]}, "plugins="),
    ],
)
def test_save_episode_refuses_unnamed_objects_unless_they_are_given_later(
    options, culprit, tmp_path
):
    env = aec_env(YARD, YARD_POINTS, **options)
    env.reset(seed=1)
    with pytest.raises(EpisodeFileError, match=f"no dotted name.*{culprit}"):
        save_episode(env, tmp_path / "a")
    assert list(tmp_path.iterdir()) == []
    save_episode(env, tmp_path / "a", unnamed=True)
    with pytest.raises(EpisodeFileError, match=r"open.*give it to load_episode"):
        load_episode(tmp_path / "a")
    assert repr(load_episode(tmp_path / "a", **options).last()) == repr(env.last())


def test_load_episode_takes_simulations_and_points_without_a_name(tmp_path):
    points = {name: YARD_POINTS[name] for name in YARD_POINTS}
    made = saved.Yard(saved.YardDesign(3, 2, 2, 2, 3, None))
    env = mid_episode(simulation=made, points=points)
    with pytest.raises(EpisodeFileError, match="the simulation: <"):
        save_episode(env, tmp_path / "a")
    save_episode(env, tmp_path / "a", unnamed=True)
    with pytest.raises(EpisodeFileError, match="simulation="):
        load_episode(tmp_path / "a")
    assert future(load_episode(tmp_path / "a", simulation=made), 3) == future(env, 3)


def test_save_episode_refuses_a_definition_that_no_module_contains(tmp_path):
    points = {name: saved.define_again() for name in list(YARD_POINTS)[:1]}
    env = mid_episode(points=points, taken=1)
    with pytest.raises(EpisodeFileError, match=r"the definition of .*Yard\.plan"):
        save_episode(env, tmp_path / "a")
    save_episode(env, tmp_path / "a", unnamed=True)
    with pytest.raises(EpisodeFileError, match=r"has no name; give it to load_episode\(.*points="):
        load_episode(tmp_path / "a")
    assert load_episode(tmp_path / "a", points=points).agent_selection == "planner"


def test_save_episode_refuses_envs_without_a_single_episode(tmp_path):
    with pytest.raises(NotResetError):
        save_episode(aec_env(YARD, YARD_POINTS), tmp_path / "a")
    env = vector_env(Pumps, num_envs=1)
    with pytest.raises(ViewError, match="one simulation"):
        save_episode(env, tmp_path / "a")
    env.close()
    found = []

    def plan(observation, *, _environment):
        try:
            save_episode(_environment, tmp_path / "a")
        except ViewError as error:
            found.append(error)
        return 1

    mid_episode(policies={"planner": plan}, taken=1)
    assert found


class Forgetful(Pumps):
    """Pumps that remember how often they were made."""

    made = 0

    def reset(self, seed=None, options=None):
        super().reset(seed, options)
        type(self).made += 1
        self.level += self.made


def test_save_episode_refuses_a_model_that_does_not_repeat_itself(tmp_path):
    env = mid_episode(simulation=Forgetful, points=None)
    with pytest.raises(EpisodeFileError, match="does not repeat the episode"):
        save_episode(env, tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_save_episode_refuses_reset_options_that_are_no_json(tmp_path):
    env = aec_env(Pumps)
    env.reset(seed=1, options={"level": [0, 0], "other": object()})
    with pytest.raises(EpisodeFileError, match="cannot be written as JSON"):
        save_episode(env, tmp_path / "a")


def test_episode_file_errors_name_files_that_cannot_be_opened(tmp_path):
    with pytest.raises(StoreError, match="nowhere"):
        save_episode(mid_episode(), tmp_path / "nowhere" / "a")
    with pytest.raises(StoreError, match="nowhere"):
        load_episode(tmp_path / "nowhere")


# -- differences, when it is loaded ----------------------------------------------------------------


def changed(path, number, change):
    """Change a line of a file."""
    lines = lines_of(path)
    change(lines[number])
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))


@pytest.mark.parametrize(
    ("number", "change", "problem"),
    [
        (3, {"seen": "0" * 24}, r"line 4.*the observation of a decision of .* differs"),
        (2, {"agent": "nobody"}, r"line 3.*it was a decision of 'nobody', and is a decision of"),
        (4, {"mask": "1" * 24}, r"line 5.*the mask of legal actions of a decision of .* differs"),
        (5, {"action": 99}, r"line 6.*InvalidActionError"),
        (7, {"seen": "0" * 24}, r"line 8.*the observation"),
        (0, {"seed": 8}, r"line 2.*the observation"),
        (
            7,
            {"action": 3, "agent": "planner", "by": "policy"},
            r"line 8: .*the answerer of a decision of",
        ),
    ],
)
def test_load_episode_error_names_the_first_decision_that_differs(
    number, change, problem, tmp_path
):
    save_episode(mid_episode(), tmp_path / "a")
    changed(tmp_path / "a", number, lambda line: line.update(change))
    with pytest.raises(EpisodeFileError, match=problem) as caught:
        load_episode(tmp_path / "a")
    assert "Likely reasons: has the model changed?" in str(caught.value)


def test_load_episode_error_names_other_package_versions(tmp_path):
    save_episode(mid_episode(), tmp_path / "a")
    changed(tmp_path / "a", 0, lambda line: line["versions"].update(numpy="1.0", lost="2.0"))
    changed(tmp_path / "a", 3, lambda line: line.update(seen=""))
    with pytest.raises(EpisodeFileError, match=r"numpy was 1\.0, and is .*; lost was 2\.0, and is"):
        load_episode(tmp_path / "a")


def test_load_episode_refuses_an_episode_that_ends_earlier_than_saved(tmp_path):
    env = mid_episode(single_env, Pumps, points=None, agent="push", taken=12)
    save_episode(env, tmp_path / "a")
    with pytest.raises(EpisodeFileError, match=r"line 5.*the episode is over"):
        load_episode(tmp_path / "a", max_steps=3)


def test_load_episode_options_replace_the_options_of_the_file(tmp_path):
    save_episode(mid_episode(driver="thread"), tmp_path / "a")
    assert load_episode(tmp_path / "a").unwrapped.driver == "thread"
    assert load_episode(tmp_path / "a", driver="greenlet").unwrapped.driver == "greenlet"


# -- errors of the model --------------------------------------------------------------------------


class Burst(Pumps):
    """Pumps that fail on the fourth day."""

    def pull(self):
        if self.level.sum() > 0.5:
            raise ArithmeticError("it has burst")
        return super().pull()


def fail(**options):
    """Return an environment whose model has failed, and the error."""
    env = single_env(Burst, {f"{saved.__name__}.Pumps.push": None}, **options)
    env.reset(seed=11)
    error = None
    while error is None:
        try:
            env.step(RULE)
        except ArithmeticError as problem:
            error = problem
    return env, error


def test_episode_file_after_an_error_leads_to_the_decision_before_it(tmp_path):
    env, error = fail()
    assert "save_episode(env, path)" in error.__notes__[0]
    save_episode(env, tmp_path / "a")
    *_, answer, last = lines_of(tmp_path / "a")
    assert (answer["action"], last) == ({"rule": True}, {"error": "ArithmeticError: it has burst"})
    loaded = load_episode(tmp_path / "a")
    with pytest.raises(ArithmeticError, match="burst"):
        loaded.step(RULE)


# -- files that grow -------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, turn_env])
def test_recorded_episode_file_is_the_beginning_of_the_saved_file(make, tmp_path):
    env = mid_episode(make, Pumps, points=None, record=tmp_path / "all")
    save_episode(env, tmp_path / "saved")
    [path] = (tmp_path / "all").iterdir()
    grown = path.read_text()
    other = mid_episode(make, Pumps, points=None)
    save_episode(other, tmp_path / "other")
    assert (tmp_path / "saved").read_text() == (tmp_path / "other").read_text()
    assert (tmp_path / "other").read_text().startswith(grown)
    assert future(load_episode(path), 3) == future(env, 3)
    assert list((tmp_path / "all").iterdir()) == []


def test_record_keeps_the_file_of_a_failed_episode_and_the_error_names_it(tmp_path):
    env, error = fail(record=tmp_path)
    [path] = tmp_path.iterdir()
    assert f"the episode is in {path}" in error.__notes__[0]
    env.reset(seed=1)
    assert len(list(tmp_path.iterdir())) == 2
    env.close()
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ArithmeticError, match="burst"):
        load_episode(path).step(RULE)
    save_episode(load_episode(path), path)
    assert "seen" in lines_of(path)[-1]


def test_record_all_keeps_the_episode_file_of_every_episode(tmp_path):
    env = aec_env(Pumps, record=tmp_path, record_all=True)
    for seed in (1, 2):
        env.reset(seed=seed)
        while env.agents:
            env.step(None if env.terminations[env.agent_selection] else RULE)
    env.reset(seed=3)
    env.close()
    paths = sorted(tmp_path.iterdir(), key=lambda path: lines_of(path)[0]["seed"])
    ends = [line for path in paths for line in lines_of(path) if "end" in line]
    assert ends == [{"end": "terminated"}] * 2
    assert [line.get("exit") for line in lines_of(paths[0])[-2:]] == ["push", "pull"]
    loaded = load_episode(paths[0])
    assert (loaded.agents, loaded.unwrapped.session.episode.terminated) == ([], True)
    assert load_episode(paths[2]).agents == ["push", "pull"]


def test_clones_and_branches_do_not_write_into_the_recorded_file(tmp_path):
    env = mid_episode(record=tmp_path)
    [path] = tmp_path.iterdir()
    before = path.read_text()
    for method in ("fork", "replay"):
        other = clone(env, method=method)
        other.step(RULE)
        other.close()
        branch(env, lambda env, number: env.step(RULE), method=method)
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def test_vector_env_records_each_simulation(tmp_path):
    env = vector_env(Pumps, num_envs=2, view="joint", record=tmp_path)
    env.reset(seed=4)
    env.step(env.action_space.sample())
    assert sorted(lines_of(path)[0]["seed"] for path in tmp_path.iterdir()) == [4, 5]
    for path in tmp_path.iterdir():
        assert load_episode(path).unwrapped.kind == "joint"
    env.close()


def test_record_refuses_unnamed_objects_when_the_env_is_made(tmp_path):
    with pytest.raises(EpisodeFileError, match="no dotted name"):
        aec_env(lambda: YARD(), YARD_POINTS, record=tmp_path / "never")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OptionValueError, match="record must be a folder"):
        aec_env(YARD, YARD_POINTS, record=3)


def test_recorded_file_of_a_killed_process_can_be_loaded_and_continued(tmp_path):
    code = f"""
import os
from tests.worlds.saved import mid_episode
env = mid_episode(record={str(tmp_path)!r}, taken=9)
os.kill(os.getpid(), 9)
"""
    python("-c", code, status=-9)
    [path] = tmp_path.iterdir()
    env = mid_episode(taken=9)
    assert future(load_episode(path), 3) == future(env, 3)


@pytest.mark.parametrize("left", [1, 5, 40])
def test_torn_last_line_of_an_episode_file_loses_one_decision(left, tmp_path):
    env = mid_episode(record=tmp_path, taken=9)
    [path] = tmp_path.iterdir()
    written = path.read_bytes()
    last = written.splitlines()[-1]
    env.close()
    path.write_bytes(written[: -len(last) + left - 1])
    assert future(load_episode(path), 3) == future(mid_episode(taken=8), 3)


def test_recorded_file_of_a_killed_model_loads_before_the_failing_step(tmp_path):
    _, _ = fail(record=tmp_path)
    [path] = tmp_path.iterdir()
    os.truncate(path, path.read_bytes().rstrip().rfind(b"\n") + 1)  # without the error
    with pytest.raises(ArithmeticError, match="burst"):
        load_episode(path).step(RULE)


@pytest.mark.filterwarnings("ignore:yard cannot draw")
def test_save_episode_works_with_a_planning_policy_that_branches(tmp_path):
    env = mid_episode(policies={"planner": PLANNER}, taken=2)
    save_episode(env, tmp_path / "a")
    assert future(load_episode(tmp_path / "a"), 3) == future(env, 3)


PLANNER = RolloutPolicy([1, 2], futures=1, horizon=1, method="replay")


@pytest.mark.filterwarnings("ignore:yard cannot draw")
def test_planning_policies_do_not_change_the_files_of_later_episodes(tmp_path):
    env = mid_episode(policies={"planner": PLANNER}, taken=2, record=tmp_path)
    env.reset(seed=2)
    env.step(RULE)
    [path] = tmp_path.iterdir()
    assert repr(load_episode(path).last()) == repr(env.last())


def test_episode_file_keeps_the_order_of_decision_points(tmp_path):
    env = turn_env(Pumps, list(Pumps.points)[::-1])
    observation, _ = env.reset(seed=1)
    save_episode(env, tmp_path / "a")
    assert repr(load_episode(tmp_path / "a").latest[0]) == repr(observation)


def test_save_episode_refuses_an_env_in_a_running_step_or_reset(tmp_path):
    found = []

    def use(observation):
        with pytest.raises(ReentrancyError):
            save_episode(env, tmp_path / "a")
        found.append(1)
        return 1

    env = aec_env(YARD, YARD_POINTS, policies={"planner": use})
    env.reset(seed=1)
    assert found


def test_save_episode_works_with_record_all(tmp_path):
    env = aec_env(Pumps, record=tmp_path / "all", record_all=True, max_steps=2)
    env.reset(seed=1)
    while env.agents:
        env.step(None if env.truncations[env.agent_selection] else RULE)
    save_episode(env, tmp_path / "a")
    loaded = load_episode(tmp_path / "a", record=None)
    assert (loaded.agents, loaded.unwrapped.episode.truncated) == ([], True)


def test_loaded_episode_is_recorded_again(tmp_path):
    save_episode(mid_episode(), tmp_path / "a")
    loaded = load_episode(tmp_path / "a", record=tmp_path / "b")
    loaded.step(RULE)
    [path] = (tmp_path / "b").iterdir()
    assert repr(load_episode(path).last()) == repr(loaded.last())


class Rare(Pumps):
    """Pumps that do not push in every episode."""

    points = Pumps.points

    def run(self):
        if self.random.random() < 0.3:
            super().run()


def test_record_leaves_no_file_for_seeds_without_a_decision(tmp_path):
    env = single_env(Rare, agent="push", record=tmp_path, record_all=True)
    env.reset(seed=0)
    env.reset(seed=2)
    env.close()
    assert len(list(tmp_path.iterdir())) == 2
    for path in tmp_path.iterdir():
        assert load_episode(path).unwrapped.own_agent.name == "push"
