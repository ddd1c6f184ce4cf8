"""Section 17 of the contract: tasks of a model that wait for policies together."""

import asyncio
import gc
import threading
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    aec_env,
    clone,
    evaluate,
    load_episode,
    make_step,
    save_episode,
    simulate,
    simulate_many,
    single_env,
)
from simenv_marl.data import collect_episodes
from simenv_marl.errors import AgentError, InvalidActionError
from simenv_marl.seats import FallbackPolicy, RecordedPolicy


class Member:
    """Speaks in a round, and notes when it asks and when it has spoken."""

    def __init__(self, council, number):
        self.council, self.name = council, f"m{number}"

    async def speak(self):
        """Say a number."""
        await asyncio.sleep(0)
        self.council.log.append(f"{self.name} rules")
        return 1

    async def turn(self):
        self.council.log.append(f"{self.name} asks")
        said = await self.speak()
        self.council.log.append(f"{self.name} says {said}")


class Council:
    """In each round, all members speak in tasks of one event loop; then the chair decides."""

    size = 3
    rounds = 2

    def reset(self, seed=None):
        self.log = []
        self.members = [Member(self, number) for number in range(self.size)]

    def run(self):
        asyncio.run(self.meet())

    async def meet(self):
        for _ in range(self.rounds):
            await asyncio.gather(*(member.turn() for member in self.members))
            self.log.append(f"chair: {await self.close_round()}")

    async def close_round(self):
        return 0


def define(**changes):
    given = {
        "observation_space": spaces.Box(0, 1000, (1,), np.float64),
        "observation_space_mapping": lambda member: [len(member.council.log)],
        "action_space": spaces.Discrete(10),
        "action_space_mapping": int,
        "reward_mapping": lambda member: float(len(member.council.log)),
        "agent": lambda member: member.name,
    }
    return make_step(**given | changes)


SPEAK = define()
CHAIR = define(
    agent="chair",
    observation_space_mapping=lambda council: [len(council.log)],
    reward_mapping=lambda council: float(len(council.log)),
)
POINTS = {Member.speak: SPEAK, Council.close_round: CHAIR}


def counting(seconds=lambda number: 0.0):
    """A policy that answers by the number of its agent, and notes who was asked."""

    async def policy(observation, *, _decision):
        number = int(_decision.agent[1:])
        policy.asked.append((_decision.agent, observation[0], policy.open))
        policy.open += 1
        await asyncio.sleep(seconds(number))
        policy.open -= 1
        policy.ended.append(number)
        return number + 5

    policy.asked, policy.ended, policy.open = [], [], 0
    return policy


async def tired(observation):
    await asyncio.sleep(0.001)
    return RULE


def log_of(simulation):
    return simulation.log


def played(policies, simulation=Council, points=POINTS, **options):
    return simulate(simulation, policies, points=points, seed=1, **options).log


def speaking(policy):
    return {Member.speak: policy}


TOGETHER = [
    *(f"m{n} asks" for n in range(3)),
    *(f"m{n} says {n + 5}" for n in range(3)),
    "chair: 0",
] * 2


# -- the order of events --------------------------------------------------------------------------


def test_coroutine_policies_answer_decisions_of_asyncio_tasks_in_order():
    policy = counting(lambda number: 0.03 - 0.01 * number)  # the last one answers first
    assert played(speaking(policy)) == TOGETHER
    assert policy.ended == [2, 1, 0] * 2
    assert [name for name, *_ in policy.asked] == ["m0", "m1", "m2"] * 2
    assert [are_open for *_, are_open in policy.asked] == [0, 1, 2] * 2
    assert [seen for _, seen, _ in policy.asked] == [1, 2, 3, 8, 9, 10]  # when each decision arose


def test_plain_policies_answer_decisions_of_asyncio_tasks_at_once():
    plain = Council()
    plain.reset()
    plain.run()
    assert played({}) == plain.log
    assert played(speaking(lambda observation: RULE)) == plain.log
    quick = played(speaking(lambda observation: 3))
    assert quick[:4] == ["m0 asks", "m0 says 3", "m1 asks", "m1 says 3"]


def test_coroutine_policy_that_answers_rule_lets_the_models_rule_decide():
    log = played(speaking(tired))
    assert log[:3] == ["m0 asks", "m1 asks", "m2 asks"]
    assert log[3:7] == ["m0 rules", "m0 says 1", "m1 rules", "m1 says 1"]


def test_plain_policies_answer_before_coroutine_policies():
    log = played({"m0": counting(), "m1": lambda observation: 3})
    assert log[:7] == [
        "m0 asks",
        "m1 asks",
        "m1 says 3",
        "m2 asks",
        "m2 rules",
        "m2 says 1",
        "m0 says 5",
    ]


def test_every_env_gets_decisions_of_asyncio_tasks_in_the_same_order():
    policies = speaking(counting(lambda number: 0.003 - 0.001 * number))
    given = {"points": POINTS}
    logs = simulate_many(Council, policies, seeds=range(5), collect=log_of, concurrency=2, **given)
    assert logs == [TOGETHER] * 5
    found = collect_episodes(Council, policies, seeds=range(3), collect=log_of, **given)
    (data,) = found.values()
    assert list(data.collected) == [TOGETHER] * 3
    assert data.actions[:6].tolist() == [5, 5, 6, 6, 7, 7]
    table = evaluate(
        Council,
        {"them": policies},
        seeds=range(2),
        metric=lambda council: float(council.log == TOGETHER),
        **given,
    ).frame
    assert (table["metric"] == 1).all()
    env = single_env(Council, POINTS, agent="chair", policies=policies)
    env.reset(seed=1)
    env.step(0)
    env.step(0)
    assert env.unwrapped.simulation.log == TOGETHER
    env.close()


def test_rewards_of_asyncio_tasks_are_computed_at_each_decision():
    found = collect_episodes(Council, speaking(counting()), seeds=[1], points=POINTS)
    (data,) = found.values()
    assert data.rewards.tolist() == [8.0, 14.0, 9.0, 14.0, 10.0, 14.0]


def test_max_steps_end_an_episode_while_asyncio_tasks_wait():
    found = collect_episodes(
        Council,
        speaking(counting()),
        seeds=[1],
        points=POINTS,
        max_steps=4,
        collect=log_of,
    )
    (data,) = found.values()
    assert len(data) == 4
    assert data.collected[0] == TOGETHER[:10]


class Steps(Council):
    """Has another event loop for each round."""

    def run(self):
        for _ in range(self.rounds):
            asyncio.run(self.meet_once())

    async def meet_once(self):
        await asyncio.gather(*(member.turn() for member in self.members))
        self.log.append(f"chair: {await self.close_round()}")


def test_model_that_makes_an_event_loop_per_step_gives_the_same_decisions():
    assert played(speaking(counting()), Steps) == TOGETHER


class Fifty(Council):
    size = 50


@pytest.mark.parametrize("many", [1, 4])
def test_fifty_asyncio_tasks_wait_for_coroutine_policies_at_the_same_time(many):
    policy = counting(lambda number: 0.05)

    async def patient(observation, *, _decision):
        await policy(observation, _decision=_decision)
        return 1

    simulate_many(Fifty, speaking(patient), seeds=range(many), points=POINTS)
    assert max(are_open for *_, are_open in policy.asked) >= 49


# -- other tasks of the loop ----------------------------------------------------------------------


class Restless(Council):
    rounds = 1

    async def meet(self):
        beside = asyncio.create_task(self.beside())
        await super().meet()
        self.log.append("met")
        beside.cancel()
        with suppress(asyncio.CancelledError):
            await beside


class Polling(Restless):
    async def beside(self):
        while True:
            await asyncio.sleep(0)


class Timed(Restless):
    async def beside(self):
        await asyncio.sleep(0.03)
        self.log.append("time is up")


@pytest.mark.parametrize("kind", [Polling, Timed])
def test_asyncio_models_that_poll_or_sleep_work_with_coroutine_policies(kind):
    log = played(speaking(counting(lambda number: 0.05)), kind)
    if kind is Timed:  # its time was up while the answers came, but they were asked for first
        assert log.index("time is up") > log.index("m0 says 5")
    assert [line for line in log if line != "time is up"] == [*TOGETHER[:7], "met"]


class Impatient(Council):
    rounds = 2

    async def meet(self):
        for _ in range(self.rounds):
            tasks = [asyncio.create_task(member.turn()) for member in self.members]
            await asyncio.sleep(0)
            tasks[1].cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


def test_coroutine_policy_is_not_asked_for_a_task_that_the_model_cancels():
    policy = counting()
    log = played(speaking(policy), Impatient)
    asks, says = TOGETHER[:3], ["m0 says 5", "m2 says 7"]
    assert log == [*asks, *says] * 2
    assert [name for name, *_ in policy.asked] == ["m0", "m2"] * 2


class Twins(Council):
    async def meet(self):
        member = self.members[0]
        await asyncio.gather(
            asyncio.create_task(member.turn(), name="one"),
            asyncio.create_task(member.turn(), name="two"),
        )


def test_agent_that_decides_in_two_asyncio_tasks_at_once_raises_an_error():
    with pytest.raises(AgentError, match="'m0' decides in two tasks that wait, one and two"):
        played(speaking(counting()), Twins)


# -- what is asked, and how it is applied ---------------------------------------------------------


def test_coroutine_policy_keeps_the_observation_from_when_it_was_asked():
    shown = []

    async def reader(observation, *, _decision):
        await asyncio.sleep(0)
        shown.append((_decision.display["lines"], _decision.action_labels[0], _decision.question))
        return 0

    points = {
        Member.speak: define(
            choices=lambda member: [len(member.council.log), "other"],
            action_space=spaces.Discrete(2),
            action_space_mapping=None,
            question=lambda member: f"line {len(member.council.log)}?",
            display_mapping=lambda member: {"lines": len(member.council.log)},
        )
    }
    log = played(speaking(reader), points=points)
    assert shown[:3] == [(n, str(n), f"line {n}?") for n in (1, 2, 3)]
    assert log[3:6] == ["m0 says 1", "m1 says 2", "m2 says 3"]


def test_apply_runs_in_the_asyncio_task_after_a_coroutine_policys_answer():
    async def apply(action, member, *, _rule):
        member.council.log.append(f"{member.name} applies {action}")
        return action + await _rule(member)

    points = {Member.speak: define(action_space_mapping=None, apply=apply)}
    log = played(speaking(counting()), points=points)
    assert log[3:6] == [f"m{n} applies {n + 5}" for n in range(3)]
    assert log[6:10] == ["m0 rules", "m0 says 6", "m1 rules", "m1 says 7"]


# -- recordings, copies, errors -------------------------------------------------------------------


@pytest.mark.parametrize("many", [False, True])
def test_recording_repeats_coroutine_policies_answers_without_asking(many, tmp_path):
    def run(policy):
        policy = FallbackPolicy(RecordedPolicy(policy, tmp_path / "answers"), tired)
        if many:
            given = {"seeds": range(4), "points": POINTS}
            return simulate_many(Council, speaking(policy), collect=log_of, **given), policy.counts
        return played(speaking(policy)), policy.counts

    failing = counting(lambda number: 0.002 * number)

    async def unreliable(observation, *, _decision):
        answer = await failing(observation, _decision=_decision)
        return 77 if _decision.agent == "m1" else answer

    async def refuse(observation, *, _decision):
        pytest.fail("it was asked again")

    first = run(unreliable)
    assert first[1]["illegal"] == first[1]["fallbacks"] == (8 if many else 2)
    assert run(refuse) == first


def test_clones_and_saved_episodes_with_waiting_tasks_continue_alike(tmp_path):
    env = aec_env(Council, POINTS, policies=speaking(tired))
    env.reset(seed=1)
    env.step(4)
    logs = []
    save_episode(env, tmp_path / "episode", unnamed=True)
    loaded = load_episode(
        tmp_path / "episode",
        simulation=Council,
        points=POINTS,
        policies=speaking(tired),
    )
    twins = [clone(env), clone(env, method="replay"), loaded, env]
    for twin in twins:
        twin.step(3)
        logs.append(twin.unwrapped.call(lambda view: view.unwrapped.simulation.log))
        twin.close()
    assert logs == [logs[0]] * len(twins)
    assert [line for line in logs[0] if "chair" in line] == ["chair: 4", "chair: 3"]


class Mixed(Council):
    """The chair decides while members wait."""

    async def meet(self):
        for _ in range(self.rounds):
            await asyncio.gather(*(member.turn() for member in self.members), self.chair())

    async def chair(self):
        self.log.append(f"chair: {await self.close_round()}")


def test_aec_env_asks_the_user_at_once_while_asyncio_tasks_wait():
    policies = speaking(FallbackPolicy(counting(), lambda observation: 9))
    env = aec_env(Mixed, POINTS, policies=policies)
    env.reset(seed=1)
    assert env.unwrapped.simulation.log == ["m0 asks", "m1 asks", "m2 asks"]
    twins = [clone(env), clone(env, method="replay")]
    for each, said in [(env, [5, 6, 7]), *((twin, [9, 9, 9]) for twin in twins)]:
        each.step(2)
        log = each.unwrapped.call(lambda view: view.unwrapped.simulation.log)
        assert log[:7] == [
            *TOGETHER[:3],
            "chair: 2",
            *(f"m{number} says {answer}" for number, answer in enumerate(said)),
        ]
        each.close()


def test_env_can_be_closed_while_asyncio_tasks_wait():
    before = threading.active_count()
    env = aec_env(Mixed, POINTS, policies=speaking(counting()))
    env.reset(seed=1)
    env.reset(seed=2)
    env.close()
    gc.collect()
    assert threading.active_count() <= before + 1  # the policies' own


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize(
    ("answer", "error"), [(77, InvalidActionError), (ValueError("no"), ValueError)]
)
def test_first_invalid_answer_of_coroutine_policies_is_raised(answer, error, many):
    async def wrong(observation, *, _decision):
        await asyncio.sleep(0.003 if _decision.agent == "m1" else 0)
        if _decision.agent == "m0":
            return 1
        if isinstance(answer, Exception):
            raise answer
        return answer

    run = partial(simulate_many, seeds=[1]) if many else partial(simulate, seed=1)
    with pytest.raises(error) as caught:
        run(Council, speaking(wrong), points=POINTS)
    assert any("of 'm1' at" in note for note in caught.value.__notes__)
