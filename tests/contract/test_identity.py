"""An environment never changes its model: random process models, in random use, in all views."""

import gc

import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, SimEnvError, aec_env, joint_env, parallel_env, simulate, single_env
from simenv_marl.errors import InvalidActionError, ResetNeededError
from tests.extent import examples
from tests.worlds.models import VIEWS, follow_the_rule
from tests.worlds.random_worlds import (
    HERE,
    YARD_PLAN,
    YARD_POINTS,
    YARD_ROSTER,
    Yard,
    plain_yard,
    seeds,
    yard_designs,
    yard_outcome,
)


def seeing(machine_or_yard, *args, **kwargs):
    """A handler that changes nothing."""


PLUGINS = [
    (seeing, f"{HERE}.{target}", position)
    for target, position in (
        ("Yard.note", "before"), ("Yard.plan", "before"), ("Yard.plan", "after"),
        ("Machine.load", "after"), ("Machine.pace", "before"), ("Machine.work", "before_next"),
        ("Yard.manage", "after_next"),
    )
]  # fmt: skip
OPTIONS = st.sampled_from(
    [{}, {"plugins": PLUGINS}, {"global_rng": True}, {"state_space": spaces.Box(0, 1e4, (2,))}]
)


def made(view, design, **options):
    """An environment of a yard."""
    if view is joint_env:
        options["possible_agents"] = YARD_ROSTER
    return view(
        lambda: Yard(design),
        YARD_PLAN if view is single_env else YARD_POINTS,
        render_mode="ansi",
        **options,
    )


# -- one model, many readings ---------------------------------------------------------------------


@given(yard_designs, seeds, OPTIONS)
@examples(150)
def test_every_env_with_rule_actions_runs_like_the_model_without_env(design, seed, options):
    expected = yard_outcome(plain_yard(design, seed))
    for view in VIEWS:
        env = made(view, design, **options)
        assert yard_outcome(follow_the_rule(env, seed)) == expected, view
        env.close()
    assert (
        yard_outcome(simulate(lambda: Yard(design), points=YARD_POINTS, seed=seed, **options))
        == expected
    )
    assert (
        yard_outcome(
            simulate(lambda: Yard(design), dict.fromkeys(YARD_POINTS, RULE), seed=seed, **options)
        )
        == expected
    )


# -- random use -----------------------------------------------------------------------------------


class Player:
    """Uses an environment, and keeps what it was told and what it has answered."""

    def __init__(self, view, design, options):
        self.given = view, design, options
        self.view, self.env = view, made(view, design, **options)
        self.seed, self.over = None, True

    def reset(self, seed):
        self.seed, self.actions, self.over = seed, [], False
        self.told = [str(self.env.reset(seed=seed)), *self.look()]

    def step(self, action):
        """Take a step; those that decide take an integer, or the rule."""
        if self.over:
            return
        self.actions.append(action)
        env = self.env
        if self.view is aec_env:
            result = env.step(None if self.ended() else action)
        elif self.view is parallel_env:
            result = env.step(dict.fromkeys(env.agents[: 1 + len(self.actions) % 4], action))
        else:
            joint = self.view is joint_env and action is not RULE
            result = env.step(dict.fromkeys(env.action_space, action) if joint else action)
        self.over = not env.agents if hasattr(env, "agents") else result[2] or result[3]
        self.told += [str(result), *self.look()]

    def ended(self):
        """Whether the episode of the agent that is selected has ended."""
        return (
            self.env.terminations[self.env.agent_selection]
            or self.env.truncations[self.env.agent_selection]
        )

    def look(self):
        """Look at everything that there is to be seen; nothing changes for that."""
        env, seen = self.env, []
        if self.view is aec_env and env.agents:
            seen += [env.agent_selection, str(env.last()), str(env.rewards), str(env.infos)]
            seen += [str(env.observe(agent)) for agent in env.agents]
        return [*seen, str(env.unwrapped.state()), env.render()]

    def err(self):
        """Do what is refused."""
        actions = ["nonsense", -1, None]
        if self.view is aec_env and not self.over and self.ended():
            actions = ["nonsense"]  # None is its legal action
        for action in actions:
            with pytest.raises(InvalidActionError if not self.over else SimEnvError):
                self.env.step(action)

    def close(self):
        self.env.close()
        self.over, self.seed = True, None
        with pytest.raises(ResetNeededError, match="call reset"):
            self.env.step(RULE)

    def check(self):
        """The episode equals one in a separate environment, without observers or clones."""
        if self.seed is None:
            return
        other = Player(*self.given)
        other.reset(self.seed)
        for action in self.actions:
            other.step(action)
        assert other.told == self.told
        ours, theirs = self.env.simulation, other.env.simulation
        assert (ours.trace, ours.random.getstate()) == (theirs.trace, theirs.random.getstate())
        other.env.close()


uses = st.lists(
    st.tuples(
        st.integers(0, 2),
        st.sampled_from(
            ["step", "step", "step", "rule", "rule", "reset", "close", "look", "err", "plain", "gc"]
        ),
        st.integers(0, 9),
    ),
    min_size=5,
    max_size=40,
)


@given(
    yard_designs, st.lists(st.tuples(st.sampled_from(VIEWS), OPTIONS), min_size=3, max_size=3), uses
)
@examples(120)
def test_envs_used_in_random_order_do_not_affect_each_other(design, kinds, sequence):
    players = [Player(view, design, options) for view, options in kinds]
    for which, what, number in sequence:
        player = players[which]
        if what in ("step", "rule"):
            if player.seed is None:
                player.reset(number)
            player.step(RULE if what == "rule" else number)
        elif what in ("reset", "close"):
            player.check()
            player.reset(number) if what == "reset" else player.close()
        elif what == "look" and not player.over:
            assert player.look() == player.look()
        elif what == "err":
            player.err()
        elif what == "plain":
            assert yard_outcome(plain_yard(design, number)) == yard_outcome(
                plain_yard(design, number)
            )
        else:
            gc.collect(0)
    for player in players:
        if not player.over:
            player.check()
        player.env.close()
