"""Steps of many episodes in one thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from greenlet import getcurrent

from ..hooks.stacks import EVALUATING
from .driver import WAIT
from .episode import Episode


def step_all(
    episodes: Sequence[Episode],
    actions: Sequence[Any],
    blame: Callable[[int, BaseException], None] = lambda number, error: None,
) -> None:
    """Answer the pending decisions of many episodes, and run each episode to its next decision.

    All simulations move before any agent is updated, so that the data of each loop stays in the processor's caches.

    Args:
        episodes: The episodes, of one plan. In each a decision is pending.
        actions: A checked action for each episode.
        blame: A function that is called with the number of the episode and the error if an episode raises.

    Raises:
        BaseException: See ``Episode.step``. The other episodes may have moved or not. They can be closed.
    """
    agents: list[Any] = [episode.pending for episode in episodes]
    callers = {episode.driver.caller for episode in episodes}
    together = callers == {getcurrent()} and not EVALUATING and None not in agents and episodes[0].plugins is None
    number = 0
    event: Any = None
    events: Any = []
    try:
        if not together:
            for number, episode in enumerate(episodes):
                episode.step(actions[number])
            return
        replies: list[Any] = []
        for number, episode in enumerate(episodes):
            replies.append(episode.answer(agents[number], actions[number]))
        for number, episode in enumerate(episodes):
            resume = episode.driver.resume
            events.append(resume(replies[number]))
        del replies
        events.reverse()  # popped one by one, so that the list keeps nothing alive that a model frees
        for number, episode in enumerate(episodes):  # noqa: B007 - the handler below needs the number
            event, args, kwargs = events.pop()
            reply = event.handle(episode, args, kwargs)
            if reply is not WAIT:
                event = args = kwargs = None
                episode.advance(reply)
    except BaseException as error:
        events = event = args = kwargs = resume = None  # so that the error's traceback does not keep them alive
        for place, episode in enumerate(episodes):
            if place == number:
                if episode.pending is None and not episode.over:
                    episode.fail(error)
                elif together:  # otherwise ``step`` has already done this
                    episode.annotate(error)
            elif episode.pending is None and not episode.over:
                episode.pending = episode.latest  # so that it can be closed
        blame(number, error)
        raise
