"""Many simulations at once tell what as many environments of their own tell."""

import copy
import gc
import multiprocessing
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, joint_env, single_env, vector_env
from simenv_marl.errors import (
    ClosedError,
    CopyError,
    EpisodeOverError,
    InvalidActionError,
    NotResetError,
    OptionValueError,
    ResetNeededError,
    UnknownOptionError,
    ViewError,
    WrongThreadError,
)
from tests.extent import examples
from tests.worlds.copied import IDS, Voyage
from tests.worlds.models import decision, fails, script, stacks
from tests.worlds.random_worlds import seeds, world_designs
from tests.worlds.vectors import (
    FORK,
    FORKS,
    MODES,
    POINT,
    VARIETY,
    Counter,
    TimedCounter,
    agree,
    definition,
    made,
    same,
)

pytestmark = FORKS
PROCESSES = pytest.mark.parametrize("processes", [0, 2])


@PROCESSES
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", VARIETY)
def test_vector_env_matches_gymnasiums_sync_vector_env(kind, mode, processes):
    model, decision = VARIETY[kind]
    points = {POINT: decision}
    options = {"discount_rate": 0.1} if model is TimedCounter else {}
    given = {"num_envs": 5, "autoreset_mode": mode, "workers": processes, "context": FORK}
    ours = vector_env(model, points, **given, **options)
    theirs = SyncVectorEnv([lambda: single_env(model, points, **options)] * 5, autoreset_mode=mode)
    for name in (
        "single_observation_space",
        "single_action_space",
        "observation_space",
        "action_space",
    ):
        assert getattr(ours, name) == getattr(theirs, name)
    assert ours.metadata == theirs.metadata
    assert ours.render_mode == theirs.render_mode
    agree(ours, theirs, 40, np.random.default_rng(1))
    assert same(ours.np_random_seed, theirs.np_random_seed)
    assert [g.random() for g in ours.np_random] == [g.random() for g in theirs.np_random]
    samples = [
        [space.sample() for space in envs.get_attr("action_space")] for envs in (ours, theirs)
    ]
    assert same(*samples)


@given(
    world_designs(),
    seeds,
    st.sampled_from(MODES),
    st.integers(1, 4),
    st.sampled_from([*[0] * 9, 1, 3]),
)
@examples(150)
def test_vector_env_matches_sync_vector_env_in_random_models(design, seed, mode, number, processes):
    ours = made(design, number, mode, workers=processes, context=FORK)
    if ours is None:
        return
    theirs = made(design, number, mode, sync=True)
    agree(ours, theirs, 15, np.random.default_rng(seed))
    assert [s.trace for s in ours.get_attr("simulation")] == [
        s.trace for s in theirs.get_attr("simulation")
    ]


def begun(envs, seed=0):
    envs.reset(seed=seed)
    return envs


@PROCESSES
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("flatten", [False, True])
def test_vector_env_of_joint_env_matches_sync_vector_env(flatten, mode, processes):
    given = {"num_envs": 3, "autoreset_mode": mode, "workers": processes, "context": FORK}
    ours = vector_env(Voyage, max_steps=3, flatten=flatten, **given)
    theirs = SyncVectorEnv(
        [lambda: joint_env(Voyage, max_steps=3, flatten=flatten)] * 3, autoreset_mode=mode
    )
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    agree(ours, theirs, 20, np.random.default_rng(0))
    ours.close()


def test_vector_env_view_option_chooses_single_or_joint_env():
    assert isinstance(
        vector_env(Counter, POINT, num_envs=2, view="joint").single_action_space, spaces.Dict
    )
    with pytest.raises(ViewError, match="needs one active decision point"):
        vector_env(Voyage, num_envs=2, view="single")


def seeds_of(envs):
    return [simulation.seed for simulation in envs.get_attr("simulation")]


def test_vector_env_reset_takes_one_seed_or_one_per_sub_environment():
    envs, drawn = vector_env(Counter, Counter.decide, num_envs=3), []
    for seed, told in ((7, [7, 8, 9]), (np.int64(4), [4, 5, 6])):
        envs.reset(seed=seed)
        assert seeds_of(envs) == list(envs.np_random_seed) == told
    for _ in range(2):
        envs.reset(seed=[3, None, 1])
        assert seeds_of(envs)[::2] == [3, 1]
        assert seeds_of(envs)[1] != 5
        envs.reset()
        drawn.append(seeds_of(envs)[::2])
    assert drawn[0] == drawn[1]
    for wrong in ([1, 2], -1, [1, 2, -3], [1.0, 2, 3]):
        with pytest.raises(OptionValueError, match="seed"):
            envs.reset(seed=wrong)
    with pytest.raises(TypeError):
        envs.reset(seed=1.5)


def test_vector_env_reset_mask_resets_only_some_sub_environments():
    envs = vector_env(Counter, Counter.decide, num_envs=3)
    with pytest.raises(NotResetError, match="no episode yet"):
        envs.step([1, 1, 1])
    with pytest.raises(NotResetError, match="no episode yet"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    envs.reset(seed=0, options={"reset_mask": np.ones(3, np.bool_)})
    envs.step([1, 1, 1])
    options = {"reset_mask": np.array([False, True, False]), "more": 1}
    observations, _ = envs.reset(seed=20, options=options)
    assert observations[:, 0].tolist() == [1, 0, 1]
    assert seeds_of(envs) == [0, 21, 2]
    assert envs.envs[1].simulation.options == {"more": 1}
    assert "reset_mask" in options
    for wrong in ([True, False, False], np.array([1, 0, 0]), np.array([True]), np.zeros(3, bool)):
        with pytest.raises(OptionValueError, match="reset_mask"):
            envs.reset(options={"reset_mask": wrong})


@PROCESSES
def test_vector_env_without_autoreset_needs_a_reset_after_an_episode(processes):
    given = {"autoreset_mode": "Disabled", "max_steps": 1, "workers": processes, "context": FORK}
    envs = begun(vector_env(Counter, Counter.decide, num_envs=3, **given))
    envs.step([1, 1, 1])
    with pytest.raises(EpisodeOverError, match=r"\[0, 1, 2\] are over.*reset_mask"):
        envs.step([1, 1, 1])
    assert counts(envs) == [1, 1, 1]
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(EpisodeOverError, match=r"\[1\] are over"):
        envs.step([1, 1, 1])
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    envs.step([1, 1, 1])


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        *(({"num_envs": number}, OptionValueError, "num_envs") for number in (0, "2", True)),
        ({"workers": -1}, OptionValueError, "workers"),
        ({"autoreset_mode": "never"}, OptionValueError, "autoreset_mode"),
        ({"view": "aec"}, OptionValueError, "view must be"),
        *(
            ({"workers": 1, "context": context}, OptionValueError, "context must be")
            for context in ("magic", 3)
        ),
        ({"max_step": 3}, UnknownOptionError, "max_steps"),
    ],
)
def test_vector_env_refuses_invalid_options(options, error, match):
    with pytest.raises(error, match=match):
        vector_env(Counter, Counter.decide, **{"num_envs": 2} | options)


def counts(envs):
    return [simulation.count for simulation in envs.get_attr("simulation")]


@PROCESSES
def test_vector_env_with_one_illegal_action_steps_no_sub_environment(processes):
    envs = begun(
        vector_env(
            Counter, {POINT: VARIETY["masked"][1]}, num_envs=3, workers=processes, context=FORK
        )
    )
    for actions, number in (
        ([1, 1, 9], 2),
        ([1, 0, 1], 1),
        ([1, 2, 1], 1),
        ([None, 1, 1], 0),
        ([RULE, 1, 1], 0),
        (np.array([1, 1, 2]), 2),
        (np.array([1.0, 1.0, 1.0]), 0),
    ):
        with pytest.raises(InvalidActionError, match=f"^sub-environment {number}: "):
            envs.step(actions)
        assert counts(envs) == [0, 0, 0]
    with pytest.raises(InvalidActionError, match="RULE is not an action in vector environments"):
        envs.step(RULE)
    for actions in ([1, 1], [1, 1, 1, 1], 1, None, "111", np.ones((3, 2), int)):
        with pytest.raises(InvalidActionError):
            envs.step(actions)
        assert counts(envs) == [0, 0, 0]
    envs.step([1, 1, 1])
    assert counts(envs) == [1, 1, 1]


def test_vector_env_of_joint_env_with_one_illegal_action_steps_none():
    envs = begun(vector_env(Voyage, num_envs=2))
    legal = {"helm_0": np.ones((2, 1)), "sail_0": np.ones((2, 1))}
    for illegal in (
        {**legal, "helm_0": np.array([[0.0], [3.0]])},
        {**legal, "sail_0": np.array([[0.0], [np.nan]])},
        {**legal, "helm_0": [np.zeros(1), RULE]},
        {"helm_0": np.zeros((2, 1))},
        RULE,
    ):
        with pytest.raises(InvalidActionError):
            envs.step(illegal)
    assert [simulation.boat.place for simulation in envs.get_attr("simulation")] == [0, 0]
    envs.step(legal)


def test_vector_env_ignores_the_action_of_a_sub_environment_that_resets():
    envs = begun(vector_env(Counter, Counter.decide, num_envs=2, max_steps=2))
    envs.step([1, 1])
    *_, truncations, _ = envs.step([1, 1])
    assert truncations.all()
    observations, rewards, terminations, truncations, _ = envs.step([99, -1])
    assert observations[:, 0].tolist() == rewards.tolist() == [0, 0]
    assert not (terminations | truncations).any()
    with pytest.raises(InvalidActionError, match="is not in its action space"):
        envs.step([99, -1])


def test_vector_env_takes_box_actions_in_other_dtypes():
    taken, box = [], VARIETY["box"][1].action_space
    mapping = {"action_space_mapping": lambda action: taken.append(action) or 3}
    envs = begun(vector_env(Counter, {POINT: definition(action_space=box, **mapping)}, num_envs=2))
    for batch in (
        [[1.0, 1.0], [1, 1]],
        *(np.ones((2, 2), dtype) for dtype in (float, int, np.float16, np.float32)),
    ):
        envs.reset(seed=0)
        envs.step(batch)
    batch[:] = 0  # the caller's own
    assert [(action.dtype, *action) for action in taken] == [(np.float32, 1, 1)] * 10
    assert envs.single_action_space is not box
    with pytest.raises(InvalidActionError, match="sub-environment 1"):
        envs.step(np.array([[0, 0], [0, 3.5]], np.float32))


@PROCESSES
@pytest.mark.parametrize("copy", [True, False])
@pytest.mark.parametrize("kind", ["plain", "nested"])
def test_vector_env_observations_are_copies_unless_copy_is_false(kind, copy, processes):
    model, decision = VARIETY[kind]
    envs = vector_env(
        model, {POINT: decision}, num_envs=2, copy=copy, workers=processes, context=FORK
    )
    told = [envs.reset(seed=0)]
    for _ in range(2):
        image = told[-1][0]["image"] if kind == "nested" else told[-1][0]
        kept = image.copy()
        told.append(envs.step([1, 1]))
        assert (
            np.shares_memory(image, told[-1][0]["image"] if kind == "nested" else told[-1][0])
            != copy
        )
        assert np.array_equal(image, kept) == copy
    assert not any(np.shares_memory(a, b) for a, b in zip(told[1][1:4], told[2][1:4], strict=True))
    envs.close()
    assert image.sum() > 0  # it can be read still


@pytest.mark.parametrize(
    "where", ["run", "observation_space_mapping", "reward_mapping", "action_space_mapping"]
)
@pytest.mark.parametrize("culprit", [0, 2])
def test_vector_env_error_names_its_sub_environment_and_reset_recovers(where, culprit):
    def fail(thing):
        if thing == 3 or (isinstance(thing, Counter) and thing.seed == culprit and thing.count):
            raise ZeroDivisionError
        return [0, 0] if where.startswith("obs") else 1

    stacks_before = stacks()
    envs = begun(
        vector_env(
            Counter, {POINT: definition(**{where: fail} if where != "run" else {})}, num_envs=3
        )
    )
    envs.envs[culprit].simulation.failing = where == "run"
    with fails(ZeroDivisionError, f"sub-environment {culprit}", f"seed {culprit}"):
        envs.step(np.where(np.arange(3) == culprit, 3, 1))
    if (where, culprit) == ("action_space_mapping", 0):
        envs.step([1, 1, 1])  # nothing had moved
        assert counts(envs) == [1, 1, 1]
    else:
        for _ in range(2):
            with pytest.raises(EpisodeOverError, match=r"an error has ended .*begin the next ones"):
                envs.step([1, 1, 1])
        with pytest.raises(EpisodeOverError, match="without a reset_mask"):
            envs.reset(options={"reset_mask": np.array([False, True, False])})
    envs.envs[culprit].simulation.failing = False
    envs.reset(seed=5)
    envs.step([1, 1, 1])
    assert counts(envs) == [1, 1, 1]
    envs.close()
    assert not stacks(stacks_before)


def test_vector_env_needs_a_full_reset_after_a_failed_reset():
    fragile = definition(observation_space_mapping=lambda self: [0, 1 // (self.seed - 66)])
    envs = vector_env(Counter, {POINT: fragile}, num_envs=2)
    with fails(ZeroDivisionError, "sub-environment 1"):
        envs.reset(seed=65)
    with pytest.raises(NotResetError, match="no episode yet"):
        envs.step([1, 1])
    envs.reset(seed=0)
    envs.step([1, 1])
    envs.envs[1].close()
    with pytest.raises(ResetNeededError, match="call reset"):
        envs.step([1, 1])


def test_vector_env_closes_sub_environments_if_one_cannot_be_made():
    class Own(Counter):
        def decide(self):
            return super().decide()

    plain, models = Own.decide, iter([Own(), Own(), Own()])
    with fails(StopIteration, "sub-environment 3"):
        vector_env(lambda: next(models), {Own.decide: definition()}, num_envs=4)
    assert Own.decide is plain  # while the error holds what has failed


@pytest.mark.parametrize(("driver", "error"), [("greenlet", WrongThreadError), ("thread", None)])
def test_vector_env_needs_the_thread_driver_for_use_in_another_thread(driver, error):
    envs = begun(vector_env(Counter, Counter.decide, num_envs=2, driver=driver))
    with ThreadPoolExecutor(1) as other:
        for method in (lambda: envs.step([1, 1]), lambda: envs.reset(seed=0), envs.close):
            assert type(other.submit(method).exception()) is (error or type(None))
    assert envs.closed == (error is None)
    if error is not None:
        assert counts(envs) == [0, 0]
        envs.step([1, 1])
        envs.close()


@PROCESSES
def test_vector_env_call_get_attr_and_set_attr_reach_sub_environments(processes):
    points = {POINT: VARIETY["goal"][1]}
    envs = begun(
        vector_env(
            TimedCounter, points, num_envs=3, render_mode="ansi", workers=processes, context=FORK
        ),
        3,
    )
    envs.step([1, 2, 3])
    assert envs.render() == ("ansi 1", "ansi 2", "ansi 3")
    assert envs.call("compute_reward", np.ones(1), np.zeros(1), {}) == (-1.0,) * 3
    if not processes:
        envs.envs.clear()  # a list for the caller
    assert counts(envs) == [1, 2, 3]
    assert seeds_of(envs) == [3, 4, 5]
    if processes:
        with pytest.raises(AttributeError, match="other processes"):
            envs.envs  # noqa: B018
    else:
        assert [env.simulation for env in envs.envs] == list(envs.get_attr("simulation"))
    for value, told in (("same", ("same",) * 3), ((1, 2, 3), (1, 2, 3))):
        envs.set_attr("tag", value)
        assert envs.get_attr("tag") == told
    with pytest.raises(OptionValueError):
        envs.set_attr("tag", [1, 2])
    spaces_of = envs.get_attr("action_space")
    assert len({id(space) for space in spaces_of}) == 3
    assert spaces_of[0] == envs.single_action_space
    for use in (envs.get_attr, envs.call):
        with pytest.raises(AttributeError, match="nothing_of_that_name"):
            use("nothing_of_that_name")
    assert envs.unwrapped is envs


def test_vector_env_cannot_be_copied_or_pickled():
    envs = vector_env(Counter, Counter.decide, num_envs=2)
    for use in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(CopyError, match="cannot be copied or pickled"):
            use(envs)


@PROCESSES
def test_vector_env_close_unwinds_all_simulations_and_can_be_repeated(processes):
    stacks_before, processes_before = stacks(), set(multiprocessing.active_children())
    for prepare in (
        lambda envs: None,
        lambda envs: envs.reset(),
        lambda envs: envs.reset() and envs.step([1, 1]),
    ):
        envs = vector_env(Counter, Counter.decide, num_envs=2, workers=processes, context=FORK)
        prepare(envs)
        simulations = envs.get_attr("simulation")
        envs.close()
        envs.close()
        assert envs.closed
        if not processes:
            assert all(
                simulation.unwound for simulation in simulations if hasattr(simulation, "count")
            )
        for use in (
            envs.reset,
            lambda envs=envs: envs.step([1, 1]),
            lambda envs=envs: envs.call("simulation"),
        ):
            with pytest.raises(ClosedError, match="the environment is closed"):
                use()
    assert not stacks(stacks_before)
    assert set(multiprocessing.active_children()) <= processes_before


def test_vector_env_close_unwinds_all_simulations_even_if_one_fails():
    stacks_before = stacks()

    class Stubborn(Counter):
        def run(self):
            try:
                super().run()
            finally:
                if self.seed:
                    raise LookupError("it would not go")

    envs = begun(vector_env(Stubborn, {POINT: definition()}, num_envs=3))
    simulations = envs.get_attr("simulation")
    with fails(LookupError, "sub-environment 1", "sub-environment 2 raised LookupError"):
        envs.close()
    assert all(simulation.unwound for simulation in simulations)
    assert envs.closed
    assert not stacks(stacks_before)


def test_dropped_vector_env_unwinds_all_simulations():
    stacks_before = stacks()
    simulations = begun(vector_env(Counter, Counter.decide, num_envs=2)).get_attr("simulation")
    gc.collect()
    assert all(simulation.unwound for simulation in simulations)
    assert not stacks(stacks_before)


@pytest.mark.parametrize("identity", IDS[:-1])
def test_make_vec_makes_a_vector_env_of_registered_ids(identity):
    given = {"num_envs": 3, "max_steps": 3}
    ours = gymnasium.make_vec(identity, vectorization_mode="vector_entry_point", **given)
    assert type(ours).__name__ == "SimulationVectorEnv"
    assert ours.spec.id == identity
    ours.spec.to_json()
    agree(
        ours,
        gymnasium.make_vec(identity, vectorization_mode="sync", **given),
        12,
        np.random.default_rng(0),
    )
    envs = gymnasium.make_vec(
        identity, num_envs=2, autoreset_mode="SameStep", workers=1, context=FORK
    )
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    envs.close()


def test_vector_env_step_keeps_no_reference_to_mapped_actions():
    class Answer:
        pass

    answers, there = weakref.WeakSet(), []

    def answer(action):
        made = Answer()
        answers.add(made)
        return made

    reward = lambda: there.append(len(answers)) or 0.0  # noqa: E731
    decide = decision(agent="a_0", action_space_mapping=answer, reward_mapping=reward)
    envs = begun(
        vector_env(
            script(lambda simulation: [decide() and None for _ in range(3)]), decide, num_envs=4
        )
    )
    there.clear()
    envs.step(np.ones(4, np.int64))
    assert there == [0] * 4
