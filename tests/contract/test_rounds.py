"""The parallel view: what becomes of the actions of a round."""

from collections import Counter

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, SimulationInterface, branch, joint_env, parallel_env
from simenv_marl.envs import pad_agents
from simenv_marl.errors import (
    ClosedError,
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    NotResetError,
    UnknownAgentError,
)
from tests.extent import examples
from tests.worlds.entities import (
    AnnouncingColony,
    AnsweredColony,
    Colony,
    answer,
    beings,
    colony,
    colony_designs,
    life,
    seeds,
)
from tests.worlds.models import calling, decision, define, notes, script


def flags(results):
    """By agent: terminated, truncated."""
    assert all(type(flag) is bool for part in results[2:4] for flag in part.values())
    return {agent: (results[2][agent], results[3][agent]) for agent in results[2]}


def acted(results):
    """The agents whose actions were used."""
    return {agent for agent, info in results[-1].items() if info["acted"]}


# -- the rule of rounds ---------------------------------------------------------------------------


class Auction(SimulationInterface):
    """Asks two bidders at each price, and tells the next price before."""

    def reset(self, seed=None):
        self.price = 0

    def expected_calls(self, point):
        return [(self, bidder, self.price) for bidder in ("ann", "bob")]

    def run(self):
        for self.price in (10, 20, 30):
            for bidder in ("ann", "bob"):
                self.bid(bidder, self.price)

    def bid(self, bidder, price):
        return 0


def test_parallel_env_observes_expected_calls_in_each_round():
    definition = define(
        agent=lambda auction, bidder, price: bidder,
        observation_space_mapping=lambda auction, bidder, price: [price, 0],
    )
    env = parallel_env(Auction, {Auction.bid: definition})
    seen = [env.reset()[0]]
    while env.agents:
        seen.append(env.step(dict.fromkeys(env.agents, 0))[0])
    assert [float(each["bob"][0]) for each in seen] == [10, 20, 30, 30]


def test_parallel_env_observations_do_not_show_moves_of_the_same_step():
    env = parallel_env(life("0 acts, 1 health 5, 1 acts, 0 health 6", announced=[0, 1]), beings())
    observations, _ = env.reset()
    assert {agent: seen.tolist() for agent, seen in observations.items()} == {
        "being_0": [0, 0],
        "being_1": [1, 0],
    }
    observations["being_0"][:] = 7  # the user's own
    env.agents.append("me")
    observations, *_ = env.step({"being_0": 1, "being_1": 2})
    assert {agent: seen.tolist() for agent, seen in observations.items()} == {
        "being_0": [0, 6],
        "being_1": [1, 5],
    }
    assert env.agents == []


def test_parallel_env_step_answers_nested_decisions():
    inner = decision(agent="inner_0")
    outer = decision(lambda: inner() + 1, agent="outer_0")
    env = parallel_env(calling(outer), [outer, inner])
    env.reset()
    results = env.step({"outer_0": RULE, "inner_0": 5})
    assert env.simulation.log == [6]
    assert acted(results) == {"outer_0", "inner_0"}


def test_branch_replays_actions_that_a_mapping_has_changed_in_place():
    box = {
        "action_space": spaces.Box(0, 9, (1,)),
        "action_space_mapping": lambda action: action.__iadd__(1).item(),
    }
    ant = decision(agent="ant_0", **box)
    env = parallel_env(calling(ant, ant), ant)
    env.reset(seed=0)
    env.step({"ant_0": np.zeros(1, np.float32)})  # which the mapping changes
    assert branch(env, lambda twin, _: twin.simulation.log, 1, method="replay") == [[1.0]]


def play_rounds(env, share, rounds=10):
    """Play rounds with an action for the second agent in a share of them."""
    env.reset(seed=0)
    for number in range(rounds):
        env.step(
            {"ant_0": 1, "bee_0": 1} if number < share * rounds else {"ant_0": 1, "bee_0": RULE}
        )


@pytest.mark.filterwarnings("error")
def test_parallel_env_warns_once_of_the_number_of_unused_actions():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")

    def main(simulation):
        for _ in range(10):
            ant()
            if not simulation.log:
                simulation.log.append(bee())

    env = parallel_env(script(main), [ant, bee], possible_agents=None)
    play_rounds(env, 0.2)  # 11 of 12 were used
    nine = parallel_env(script(lambda simulation: [bee(), *(ant() for _ in range(8))]), [ant, bee])
    play_rounds(nine, 0.2, 8)  # 9 of 10
    with pytest.warns(
        UserWarning, match=r"of 15 actions in this episode, 11 were used: .* aec_env loses none"
    ):
        play_rounds(env, 0.5)
    play_rounds(env, 0.5)  # once for each environment


# -- actions that are refused ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("actions", "error", "match"),
    [
        *(
            (given, UnknownAgentError, "not a live agent")
            for given in ({"ant_0": 1, "nobody": 1}, {"ant_0": 1, 0: 1})
        ),
        ({"ant_0": 10, "bee_0": 1}, InvalidActionError, "action"),
        *(
            ({"ant_0": 1, "bee_0": wrong}, InvalidActionError, "action")
            for wrong in (10, None, np.array([1]))
        ),
        *(
            (given, InvalidActionError, "takes a dict of actions")
            for given in (None, 3, "ant_0", [1, 2])
        ),
    ],
    ids=repr,
)
def test_parallel_env_is_unchanged_after_it_refuses_a_step(actions, error, match):
    calls = []
    ant, bee = (
        decision(agent=name, reward_mapping=lambda: calls.append(0) or 1.0)
        for name in ("ant_0", "bee_0")
    )
    env = parallel_env(calling(ant, bee, ant), [ant, bee])
    env.reset()
    del calls[:]
    with pytest.raises(error, match=match):
        env.step(actions)
    assert env.simulation.log == calls == []
    assert env.agents == ["ant_0", "bee_0"]
    results = env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1, 2]
    assert acted(results) == {"ant_0", "bee_0"}


@pytest.mark.parametrize("padded", [False, True])
def test_parallel_env_returns_empty_dicts_for_an_empty_step_after_the_end(padded):
    """PettingZoo's own environments do so, and wrappers rely on it."""
    ant = decision(agent="ant_0")
    env = parallel_env(calling(ant), ant)
    env = pad_agents(env) if padded else env
    with pytest.raises(NotResetError, match="no episode yet"):
        env.step({})
    env.reset()
    env.step({"ant_0": 1})
    assert env.step({}) == ({}, {}, {}, {}, {})
    for actions in ({"ant_0": 1}, RULE):
        with pytest.raises(EpisodeOverError, match="begin the next one"):
            env.step(actions)
    env.close()
    with pytest.raises(ClosedError):
        env.step({})
    env.reset()
    assert env.agents == ["ant_0"]
    env.close()
    assert env.agents == []


def test_parallel_env_accepts_empty_choices_at_the_end_of_an_episode():
    left = ["axe", "bow"]
    ant = decision(agent="ant_0", choices=lambda: left, action_space=spaces.Discrete(2))

    def main(simulation):
        while left:
            left.remove(ant())

    env = parallel_env(script(main), ant)
    env.reset()
    env.step({"ant_0": 1})
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step({"ant_0": 1})
    *_, infos = env.step({"ant_0": 0})
    assert left == env.agents == []
    assert infos["ant_0"]["action_mask"].tolist() == [1, 1]


@pytest.mark.parametrize(
    "legal",
    [
        {"choices": lambda: HAND, "action_space": spaces.Discrete(2)},
        {"action_mask_mapping": lambda: [bool(HAND)] * 10},
    ],
    ids=["choices", "mask"],
)
@pytest.mark.parametrize("make", [parallel_env, joint_env])
def test_action_mask_is_open_if_no_action_is_legal_between_decisions(make, legal):
    def main(simulation):
        for _ in range(3):
            HAND.extend("xy")
            simulation.log.append(bee())
            HAND.clear()
            ant()
            ant()

    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **legal)
    env = make(script(main), [bee, ant])
    env.reset()
    *_, info = env.step({"ant_0": RULE, "bee_0": 1} if make is joint_env else {"bee_0": 1})
    mask = info["action_mask"]["bee_0"] if make is joint_env else info["bee_0"]["action_mask"]
    assert mask.all()
    for _ in range(5):
        env.step(RULE)
    assert env.simulation.log == ["y" if "choices" in legal else 1, "rule", "rule"]
    HAND.clear()


HAND = []

# -- births and deaths ----------------------------------------------------------------------------


def test_parallel_env_drops_ended_agents_from_agents_in_the_same_step():
    program = "0 acts, 1 health 3, 1 leaves, 0 health 6, 0 leaves, 2 acts, 2 acts, 2 forgotten"
    env = parallel_env(life(program, announced=[0, 1, 2]), beings())
    env.reset()
    results = env.step({"being_0": 1, "being_1": 2, "being_2": 3})
    assert env.simulation.log == [1, 3]
    assert env.agents == ["being_2"]
    assert [set(part) for part in results] == [{"being_0", "being_1", "being_2"}] * 5
    seen = {agent: observation.tolist() for agent, observation in results[0].items()}
    assert seen == {"being_0": [0, 6], "being_1": [1, 3], "being_2": [2, 0]}
    assert results[1] == {"being_0": 6.0, "being_1": 3.0, "being_2": 0.0}
    ended = (True, False)
    assert flags(results) == {"being_0": ended, "being_1": ended, "being_2": (False, False)}
    assert acted(results) == {"being_0", "being_2"}
    assert [agent for agent, info in results[-1].items() if info["deciding"]] == ["being_2"]
    with pytest.raises(UnknownAgentError, match="being_0"):
        env.step({"being_0": 1, "being_2": 1})
    # Whoever is announced after its end is not revived.
    last = env.step({"being_2": 1})
    assert [set(part) for part in last] == [{"being_2"}] * 5
    # Whoever the model has let go cannot be observed anew.
    assert last[0]["being_2"].tolist() == [2, 0]
    assert last[0]["being_2"] is not results[0]["being_2"]


@pytest.mark.parametrize(
    ("mapping", "good"),
    [
        ("reward_mapping", 0.0),
        ("observation_space_mapping", [1, 2]),
        ("action_mask_mapping", [1] * 10),
    ],
)
def test_parallel_env_errors_in_mappings_name_the_agent_and_the_seed(mapping, good):
    def bad():
        if len(env.simulation.log) == 2:
            raise ZeroDivisionError
        return good

    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **{mapping: bad})
    env = parallel_env(calling(ant, bee, ant, bee), [ant, bee])
    env.reset(seed=17)
    with pytest.raises(ZeroDivisionError) as caught:
        env.step({"ant_0": 1, "bee_0": 1})
    assert "seed 17" in notes(caught.value)
    assert "bee_0" in notes(caught.value)
    assert env.agents == []


# -- the rule once more, literally ----------------------------------------------------------------


AGENTS = ["ant_0", "bee_0", "cat_0", "dog_0"]


def allowed(level, number, action):
    """Whether an action is legal: for every second agent it depends on the level."""
    return number % 2 == 0 or (level + action) % 3 != 0


class World:
    """A level that all its agents change, one after the other in the order of a program."""

    def __init__(self):
        self.program = []

    def reset(self, seed=None):
        self.level, self.calls = (seed or 0) % 17, 0

    def run(self):
        for number in self.program:
            value = self.decide(number)
            self.calls += 1
            self.level = (self.level * 3 + value + 1) % 17

    @define(
        agent=lambda world, number: AGENTS[number],
        observation_space_mapping=lambda world, number: [world.level, world.calls],
        reward_mapping=lambda world, number: float(world.level),
        action_space=spaces.Discrete(4),
        action_mask_mapping=lambda world, number: [
            allowed(world.level, number, action) for action in range(4)
        ],
    )
    def decide(self, number):
        return self.level % 4


class Rounds:
    """The contract's rule of rounds, without the library."""

    def __init__(self, program, seed, max_steps):
        self.max_steps = max_steps
        self.program, self.level, self.calls, self.steps = list(program), seed % 17, 0, 0
        self.joined = {self.program[0]}
        self.over = self.truncated = False

    def legal(self, agent, action):
        return action is RULE or allowed(self.level, agent, action)

    def step(self, actions):
        """Returns who has acted and who is paid, or None where the actions are refused."""
        left = dict(actions)
        pending = self.program[0]
        if pending in left and not self.legal(pending, left[pending]):
            return None
        self.steps += bool(actions)
        used = set()
        while self.program:
            agent = self.program[0]
            if agent not in left or not self.legal(agent, left[agent]):
                break
            action = left.pop(agent)
            used.add(agent)
            self.joined.add(agent)
            self.calls += 1
            self.level = (self.level * 3 + (self.level % 4 if action is RULE else action) + 1) % 17
            del self.program[0]
        paid = set(self.joined)
        self.over = not self.program
        if self.program:
            self.joined.add(self.program[0])
            self.over = self.truncated = self.steps == self.max_steps
        return used, paid


@given(
    program=st.lists(st.integers(0, 3), min_size=1, max_size=20),
    seed=st.integers(0, 16),
    max_steps=st.none() | st.integers(1, 6),
    data=st.data(),
)
@examples(150)
@pytest.mark.filterwarnings("ignore:.*agents that did not appear")
def test_parallel_env_matches_a_reference_implementation_of_random_models(
    program, seed, max_steps, data
):
    env = parallel_env(World, World.decide, possible_agents=AGENTS, max_steps=max_steps)
    env.simulation.program = program
    reference = Rounds(program, seed, max_steps)
    _, infos = env.reset(seed=seed)
    assert env.agents == env.possible_agents == AGENTS
    assert {name: (info["deciding"], info["acted"]) for name, info in infos.items()} == {
        name: (name == AGENTS[program[0]], False) for name in AGENTS
    }
    for _ in range(40):
        if reference.over:
            break
        wanted = data.draw(
            st.dictionaries(st.integers(0, 3), st.integers(0, 3) | st.just(RULE), max_size=4)
        )
        before = reference.level
        expected = reference.step(wanted)
        actions = {AGENTS[agent]: action for agent, action in wanted.items()}
        if expected is None:
            with pytest.raises(InvalidActionError, match="is masked"):
                env.step(actions)
            assert env.simulation.level == before
            continue
        used, paid = expected
        all_rule = len(actions) == 4 and set(actions.values()) == {RULE}
        observations, rewards, terminated, truncated, infos = env.step(
            RULE if all_rule else actions
        )
        assert (env.simulation.level, env.simulation.calls) == (reference.level, reference.calls)
        assert {agent for agent in AGENTS if infos[agent]["acted"]} == {
            AGENTS[agent] for agent in used
        }
        assert rewards == {
            name: float(reference.level) if n in paid else 0.0 for n, name in enumerate(AGENTS)
        }
        for number, name in enumerate(AGENTS):
            joined = number in reference.joined
            assert observations[name].tolist() == (
                [reference.level, reference.calls] if joined else [0, 0]
            )
            mask = [not joined or allowed(reference.level, number, action) for action in range(4)]
            assert infos[name]["action_mask"].tolist() == mask
        assert len({id(info["action_mask"]) for info in infos.values()}) == 4
        assert set(terminated.values()) == {reference.over and not reference.truncated}
        assert set(truncated.values()) == {reference.truncated}
        assert env.agents == ([] if reference.over else AGENTS)
        if not reference.over:
            assert [name for name in AGENTS if infos[name]["deciding"]] == [
                AGENTS[reference.program[0]]
            ]


# -- colonies -------------------------------------------------------------------------------------


def played(env, seed, in_turns):
    """Play a colony in rounds; return the totals, the fortune at each agent's start, the ends."""
    _, infos = env.reset(seed=seed)
    used, totals, joined, ended = Counter(), Counter(), {}, {}
    for _ in range(2000):
        for agent in env.agents:
            joined.setdefault(agent, env.simulation.fortune)
        agents = [agent for agent in env.agents if infos[agent]["deciding"] or not in_turns]
        actions = {agent: answer(seed, agent, used[agent]) for agent in agents}
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert set(observations) == set(rewards) == set(terminated) == set(truncated) == set(infos)
        assert set(env.agents) == {a for a in terminated if not (terminated[a] or truncated[a])}
        assert sum(info["deciding"] for info in infos.values()) == (1 if env.agents else 0)
        for agent, info in infos.items():
            assert agent not in ended
            assert observations[agent] in env.observation_space(agent)
            used[agent] += info["acted"]
            totals[agent] += rewards[agent]
            assert type(terminated[agent]) is type(truncated[agent]) is bool
            if terminated[agent] or truncated[agent]:
                ended[agent] = (terminated[agent], truncated[agent])
        if not env.agents:
            break
    assert not env.agents
    return totals, joined, ended


@given(colony_designs, seeds)
@examples(60)
def test_parallel_env_runs_random_models_with_births_like_without_an_env(design, seed):
    plain = AnsweredColony(design, seed)
    died = {entry[0] for entry in plain.trace if entry[1:] == ("died",)}
    for simulation, roster, in_turns in (
        (Colony, False, False),
        (Colony, True, False),
        (AnnouncingColony, False, False),
        (AnnouncingColony, False, True),
    ):
        env = colony(parallel_env, design, simulation, roster=roster)
        if not plain.decisions:
            with pytest.raises(NoDecisionError):
                env.reset(seed=seed)
            continue
        totals, joined, ended = played(env, seed, in_turns)
        assert env.simulation.trace == plain.trace
        assert env.simulation.random.getstate() == plain.random.getstate()
        for agent in plain.first:
            since = joined[agent] if simulation is AnnouncingColony else plain.first[agent]
            assert totals[agent] == plain.last[agent] - since
        assert simulation is AnnouncingColony or not any(
            totals[agent] for agent in totals.keys() - plain.first.keys()
        )
        assert set(ended) >= set(plain.first)
        for agent, over in ended.items():
            assert over == (
                (True, False) if agent in died or not design.truncates else (False, True)
            )
