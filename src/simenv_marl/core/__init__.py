"""The life cycle of a decision, without any view.

Five folders, each of which imports only from those below it::

    copies      copies of an environment in mid-episode, in other processes or by replays
    episodes    sessions, episodes and agents; ``episodes/episode.py`` tells what happens when
    plans       what an environment is made of: decision points, policies, options
    switching   how control switches between a simulation's stack and its user's
    values      casts and checks of observations and actions

This module lists the interface of the core. The rooms of the package use nothing else of it.
"""

from ..simulation import Action, Model, Observation
from .copies.clone import branch, clone, pending_view
from .copies.packing import pack, pack_outcome, pack_plainly, unpack, unpack_outcome
from .copies.peer import Peer, pack_request, serve
from .episodes.agent import Agent
from .episodes.base import (
    GO_ON,
    BaseSession,
    Branched,
    Recording,
    Replay,
    Reseeded,
    StateReader,
    Tape,
    checked_seed,
    close_all,
)
from .episodes.decision import Decision
from .episodes.episode import Episode
from .episodes.session import Session
from .episodes.state import EpisodeState, Outcome, UnmatchedNames, checked_actions
from .plans.options import CheckOptions, EpisodeOptions, ViewOptions, explain_arguments
from .plans.plan import Mode, Plan, Source, make_plan, source_name
from .plans.point import Labels, Point, Policy, Space
from .plans.points import Points, find_point, portable
from .plans.policies import (
    COUNTS,
    AskingPolicy,
    Caller,
    DeferredPolicy,
    EpisodePolicy,
    Info,
    PolicyWrapper,
    Where,
    count,
    has_fallback,
    is_asked_alone,
    is_planner,
    policy_for,
    split_extras,
    takes_info,
    takes_state,
    two_arguments,
    waits,
    when_answered,
)
from .plans.provenance import as_json, describe, provenance
from .switching.awaiting import Answer, Answers
from .switching.context import GlobalRandom, environment_context, preserve_generators
from .switching.exits import LoopExit
from .switching.generators import (
    Streams,
    generators_of,
    global_states,
    is_seed,
    reseed_generators,
)
from .switching.resources import acquire, release, reuse_resources
from .values.actions import ILLEGAL, MASK, Mask, action_check
from .values.common import (
    ActionCode,
    Encode,
    common_actions,
    common_observations,
    preferences,
)
from .values.spaces import blank, duplicate, same
from .values.stacking import Stacker, joined, split_batch, stacked, stacker, taken

__all__ = [  # noqa: RUF022 - by subject
    # What an environment is made of, and what happens in it.
    "Agent", "BaseSession", "Decision", "Episode", "EpisodeState", "Mode", "Plan",
    "Point", "Session", "StateReader", "UnmatchedNames", "Where", "checked_actions",
    "checked_seed", "close_all", "describe", "make_plan", "provenance",
    # Types: the first three are the aliases of values of the user.
    "Observation", "Action", "Model", "Info", "Labels", "Mask", "Points", "Policy", "Source",
    "Space", "Stacker", "CheckOptions", "EpisodeOptions", "ViewOptions",
    # Policies.
    "COUNTS", "Answer", "Answers", "AskingPolicy", "Caller", "DeferredPolicy", "EpisodePolicy",
    "PolicyWrapper", "count", "has_fallback", "is_asked_alone", "is_planner", "policy_for",
    "split_extras", "takes_info", "takes_state", "two_arguments", "waits", "when_answered",
    # Copies and other processes.
    "Peer", "acquire", "branch", "clone", "pack", "pack_outcome", "pack_plainly",
    "Branched", "GO_ON", "Outcome", "Recording", "Replay", "Reseeded", "Tape", "find_point",
    "pack_request", "pending_view", "portable", "release", "reuse_resources", "serve", "unpack",
    "unpack_outcome",
    # Values.
    "ILLEGAL", "MASK", "ActionCode", "Encode", "action_check", "as_json", "blank", "common_actions",
    "common_observations", "duplicate", "explain_arguments", "joined",
    "preferences", "same", "source_name", "split_batch", "stacked", "stacker", "taken",
    # Chance, and the user's side.
    "GlobalRandom", "LoopExit", "Streams", "environment_context", "generators_of", "global_states",
    "is_seed", "preserve_generators", "reseed_generators",
]  # fmt: skip
