"""Branches and clones of the environment that a policy is given are saved and loaded."""

from functools import partial

import pytest

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    clone,
    joint_env,
    load_episode,
    parallel_env,
    save_episode,
    simulate,
    simulate_many,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.episodes import replay_episode
from simenv_marl.errors import BranchError, EpisodeFileError, ViewError
from simenv_marl.planning import action_values
from simenv_marl.seats.play.host import Rules
from simenv_marl.seats.play.start import open_game
from tests.worlds.saved import Pumps, steady

target = {}


def step(env, number, path):
    """Take two steps in a branch, and save it. Return what comes then."""
    env.step(RULE)
    env.step(steady(env.unwrapped.own_agent.observation))
    save_episode(env, path)
    return future(env)


def future(env):
    found = [repr(env.unwrapped.latest)]
    while not (env.unwrapped.latest[2] or env.unwrapped.latest[3]):
        found.append(repr(env.step(RULE)))
    return found


def explore(observation, *, _environment):
    """Branch once, and answer by the rule."""
    do = target.pop("do", None)
    if do is not None and len(target["seen"]) == 2:
        target["found"] = do(_environment)
    elif do is not None:
        target["do"] = do
    target["seen"].append(1)
    return RULE


@pytest.fixture
def at_third():
    """Return a function that calls another in the third decision of a planner, and its result."""

    def call(do, run):
        target.clear()
        target.update(do=do, seen=[])
        run()
        return target["found"]

    return call


def play(make, **options):
    """Play an environment in which a planner pulls."""

    def run():
        env = make(Pumps, policies={"pull": explore}, **options)
        env.reset(seed=3)
        for _ in range(5):
            if make is aec_env:
                env.step(RULE)
            elif make in (parallel_env, joint_env):
                env.step({"push": RULE})
            else:
                env.step(RULE)
        env.close()

    return run


RUNS = {
    "aec": play(aec_env),
    "parallel": play(parallel_env),
    "joint": play(joint_env),
    "turn": play(turn_env),
    "single": play(single_env, agent="push"),
    "thread": play(aec_env, driver="thread"),
    "simulate": lambda: simulate(Pumps, {"pull": explore, "push": steady}, seed=3),
}


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["fork", "replay"])
@pytest.mark.parametrize("run", RUNS)
def test_save_episode_in_a_planning_policys_branch_can_be_continued(
    run, method, at_third, tmp_path
):
    if (run, method) == ("thread", "fork"):
        pytest.skip("threads are not forked")
    path = tmp_path / "branch"
    save = partial(step, path=path)
    [told] = at_third(lambda env: branch(env, save, method=method), RUNS[run])
    target.update(seen=[])
    loaded = load_episode(path)
    assert loaded.own_agent.name == "pull"
    assert future(loaded) == told
    loaded.close()


@pytest.mark.parametrize("method", ["fork", "replay"])
def test_save_episode_works_for_a_clone_in_a_planning_policy(method, at_third, tmp_path):
    def use(env):
        twin = clone(env, method=method)
        save_episode(twin, tmp_path / "at once")
        twin.step(RULE)
        save_episode(clone(twin, method=method), tmp_path / "later")
        found = future(twin)
        twin.close()
        return found

    told = at_third(use, RUNS["aec"])
    target.update(seen=[])
    assert future(load_episode(tmp_path / "later")) == told
    loaded = load_episode(tmp_path / "at once")
    loaded.step(RULE)
    assert future(loaded) == told


def test_save_episode_works_for_a_branch_of_a_recorded_env(at_third, tmp_path):
    run = play(aec_env, record=tmp_path / "all")
    save = partial(step, path=tmp_path / "branch")
    [told] = at_third(lambda env: branch(env, save), run)
    target.update(seen=[])
    assert future(load_episode(tmp_path / "branch")) == told


def test_save_episode_in_a_branch_does_not_overwrite_the_parents_file(tmp_path):
    env = aec_env(Pumps, record=tmp_path / "all")
    env.reset(seed=1)

    def save_clone(env, number):
        env.step(RULE)
        save_episode(env, tmp_path / "clone")
        return repr(env.last())

    [told] = branch(env, save_clone)
    assert repr(load_episode(tmp_path / "clone").last()) == told


@pytest.mark.filterwarnings("ignore:Pumps cannot draw")
def test_save_episode_refuses_a_branch_with_other_base_policies(at_third, tmp_path):
    def value(env):
        save_episode(env, tmp_path / "a")
        return 0.0

    def use(env):
        with pytest.raises(BranchError, match="a base decides for others"):
            action_values(
                env,
                [RULE],
                base={"push": steady},
                futures=1,
                horizon=1,
                terminal_value=value,
                method="replay",
            )
        return True

    assert at_third(use, RUNS["aec"])


def test_save_episode_refuses_a_branch_of_a_vector_env(at_third, tmp_path):
    def run():
        env = vector_env(Pumps, num_envs=1, agent="push", policies={"pull": explore})
        env.reset(seed=3)
        for _ in range(4):
            env.step(env.action_space.sample())
        env.close()

    def use(env):
        with pytest.raises(ViewError, match="one simulation"):
            branch(env, partial(step, path=tmp_path / "a"))
        return True

    assert at_third(use, run)
    assert at_third(use, lambda: simulate_many(Pumps, {"pull": explore}, seeds=[3]))


def test_play_refuses_to_open_the_episode_file_of_a_branch(at_third, tmp_path):
    at_third(lambda env: branch(env, partial(step, path=tmp_path / "a")), RUNS["aec"])
    with pytest.raises(EpisodeFileError, match="branch of a planner"):
        open_game(tmp_path / "a", None, Rules(""))


def test_replay_command_shows_a_branchs_file_up_to_its_decisions(at_third, tmp_path):
    at_third(lambda env: branch(env, partial(step, path=tmp_path / "a")), RUNS["simulate"])
    target.update(seen=[])
    head, *decisions, now = replay_episode(tmp_path / "a").splitlines()
    assert head == "Pumps, view simulate, in a branch, seed 3"
    assert [line.split()[1].strip(":") for line in decisions][-2:] == ["pull", "push"]
    assert now == "now: a decision of 'pull'"
    shorter = replay_episode(tmp_path / "a", len(decisions) - 2)
    assert shorter.splitlines()[1:-1] == decisions[:-2]
    at_once = replay_episode(tmp_path / "a", 0)  # the policies before the branch are repeated
    assert at_once.splitlines()[1:] == [*decisions[:5], "now: a decision of 'pull'"]
    lines = (tmp_path / "a").read_text().splitlines()
    (tmp_path / "a").write_text("\n".join(line for line in lines if '"branch"' not in line))
    with pytest.raises(EpisodeFileError, match="line 1 of"):
        load_episode(tmp_path / "a")
