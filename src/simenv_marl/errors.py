"""The tree of errors: one root, and leaves that are also the builtins that Python users expect.

::

    SimEnvError
    |-- DefinitionError      (ValueError)    a definition that cannot work
    |-- SimulationError      (TypeError)     something that is no simulation
    |-- UnknownPointError    (LookupError)   a decision point that is not to be found
    |-- PatchError           (TypeError)     a function that cannot be made a decision point or exposed
    |-- UnknownTargetError   (LookupError)   a function to extend that is not to be found
    |-- HandlerError         (ValueError)    a handler that does not fit, or is not attached
    |-- AgentError           (ValueError)    names of agents that clash or are none
    |-- UnknownAgentError    (LookupError)   an agent that the environment does not know
    |-- ViewError            (ValueError)    a view that these decision points do not allow
    |-- CopyError            (TypeError)     a vector environment that was to be copied
    |-- BranchError          (RuntimeError)  a branch of an episode that could not be made, or died
    |-- UnknownOptionError   (TypeError)     an option that does not exist
    |-- OptionValueError     (ValueError)    an option that cannot have this value
    |-- InvalidActionError   (ValueError)    an action that is not legal; nothing has moved
    |-- ObservationError     (ValueError)    an observation that does not fit its space
    |-- MaskError            (ValueError)    a mask that does not fit its action space
    |-- RewardError          (ValueError)    a reward that is no finite number
    |-- NoDecisionError      (RuntimeError)  an episode in which nothing was decided
    |-- ResetNeededError     (RuntimeError)  there is no episode to go on with
    |   |-- NotResetError                    ... because there was none yet
    |   |-- EpisodeOverError                 ... because it has ended or failed
    |   `-- ClosedError                      ... because the environment was closed
    |-- ReentrancyError      (RuntimeError)  an environment used while it is moving
    |-- WrongThreadError     (RuntimeError)  a thread or process that cannot go on from here
    |-- MissingExtraError    (ImportError)   a package that only an extra installs
    |-- ProcessError         (RuntimeError)  a simulator in another process, and what went wrong with it
    |   |-- ProcessDiedError    (ChildProcessError)  ... it could not be started, has ended, or has closed its pipe
    |   |-- ProcessTimeoutError (TimeoutError)  ... it has not answered, or not read what it was sent
    |   |-- RemoteError                         ... its model has raised an error
    |   `-- WireError           (ValueError)    ... it has sent, or was to be sent, what the wire does not allow
    |-- StoreError           (OSError)       a store of an experiment that cannot be read or written
    |-- WorkerError          (RuntimeError)  a process with simulations that died, or has raised what cannot be told
    `-- CheckFailedError     (AssertionError) a simulation in which a check has found errors

Every error is raised with its message alone, so that it survives pickling.
"""

import reprlib
import sys
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

__all__ = [
    "AgentError",
    "BranchError",
    "CheckFailedError",
    "ClosedError",
    "CopyError",
    "DefinitionError",
    "EpisodeOverError",
    "HandlerError",
    "InvalidActionError",
    "MaskError",
    "MissingExtraError",
    "NoDecisionError",
    "NotResetError",
    "ObservationError",
    "OptionValueError",
    "PatchError",
    "ProcessDiedError",
    "ProcessError",
    "ProcessTimeoutError",
    "ReentrancyError",
    "RemoteError",
    "ResetNeededError",
    "RewardError",
    "SimEnvError",
    "SimulationError",
    "StoreError",
    "UnknownAgentError",
    "UnknownOptionError",
    "UnknownPointError",
    "UnknownTargetError",
    "ViewError",
    "WireError",
    "WorkerError",
    "WrongThreadError",
]

_PACKAGE = str(Path(__file__).parent)

LONGEST: Final = 200
"""How many characters of a value stand in a message."""

_repr = reprlib.Repr()
_repr.maxlist = _repr.maxtuple = _repr.maxset = _repr.maxfrozenset = _repr.maxdict = _repr.maxdeque = 20
_repr.maxstring = _repr.maxother = _repr.maxlong = LONGEST


def shown(value: Any, longest: int = LONGEST) -> str:
    """What a value of a user's looks like in a message: in short, and also where its ``repr`` fails."""
    try:
        text = _repr.repr(value)
    except Exception:  # as of an integer of many thousand digits
        text = object.__repr__(value)
    return text if len(text) <= longest else f"{text[: longest - 23]}...{text[-20:]}"


def meant(name: object, known: Iterable[str], beneath: str = "") -> str:
    """A hint for messages about an unknown name.

    Args:
        name: The unknown name.
        known: The names that exist.
        beneath: What is put before each of these, such as "package.".

    Returns:
        "; did you mean this or that?", or nothing where no known name is close.
    """
    close = get_close_matches(name, known, n=3) if isinstance(name, str) else []
    return f"; did you mean {' or '.join(beneath + other for other in close)}?" if close else ""


def text_of(error: BaseException) -> str:
    """The text of an error, also where its ``str`` fails."""
    try:
        return str(error)
    except Exception:
        return "its text cannot be told"


def told(error: BaseException) -> str:
    """The class and the text of an error."""
    return f"{type(error).__name__}: {text_of(error)}"


def notes_of(error: BaseException) -> list[str]:
    """The notes of an error, also where it has something else in their place."""
    notes = None
    with suppress(Exception):
        notes = error.__notes__
    return [note for note in notes if isinstance(note, str)] if isinstance(notes, (list, tuple)) else []


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn, and point at the line outside this package that has led here."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def annotate(error: BaseException, note: str) -> None:
    """Add a note to an error, also to one that refuses to be changed, as a frozen dataclass does."""
    try:
        error.add_note(note)
    except Exception:
        with suppress(Exception):  # an error without its note is better than another one
            notes = vars(error).setdefault("__notes__", [])
            if isinstance(notes, list):
                notes.append(note)


def close_after(error: BaseException, close: Callable[[], None], what: str) -> None:
    """Close something after an error, which stays the one that is seen should closing raise another one."""
    try:
        close()
    except Exception as problem:
        annotate(error, f"simenv_marl: and {what}, when it was closed, raised {shown(problem)}")


def clear_frames(error: BaseException) -> None:
    """Have this package's frames in an error's traceback let go of what they hold, such as arguments of a model's."""
    trace = error.__traceback__
    while trace is not None:
        frame, trace = trace.tb_frame, trace.tb_next
        if frame.f_code.co_filename.startswith(_PACKAGE):
            with suppress(RuntimeError):  # it is still running
                frame.clear()


class SimEnvError(Exception):
    """Root of all errors that this library raises on its own account."""


class DefinitionError(SimEnvError, ValueError):
    """A definition of a decision point cannot work."""


class SimulationError(SimEnvError, TypeError):
    """What was given as a simulation is none, or does what none may do."""


class UnknownPointError(SimEnvError, LookupError):
    """A decision point was named that is not to be found."""


class PatchError(SimEnvError, TypeError):
    """A function was named that cannot be made a decision point, or be exposed to plugins."""


class UnknownTargetError(SimEnvError, LookupError):
    """A function was to be extended that is not to be found."""


class HandlerError(SimEnvError, ValueError):
    """A handler cannot be called like its target, there is no such position, or it is not attached."""


class AgentError(SimEnvError, ValueError):
    """The names of agents clash, or what should name an agent is no string."""


class UnknownAgentError(SimEnvError, LookupError):
    """An agent was named that the environment does not know."""


class ViewError(SimEnvError, ValueError):
    """A view was asked for that the active decision points do not allow."""


class CopyError(SimEnvError, TypeError):
    """A vector environment was to be copied or pickled."""


class BranchError(SimEnvError, RuntimeError):
    """A branch of an episode could not be made, or has died without an answer."""


class UnknownOptionError(SimEnvError, TypeError):
    """An option was given that does not exist."""


class OptionValueError(SimEnvError, ValueError):
    """An option was given a value that it cannot have."""


class InvalidActionError(SimEnvError, ValueError):
    """An action is not legal. The simulation has not moved; a legal action may follow."""


class ObservationError(SimEnvError, ValueError):
    """An observation does not fit its space."""


class MaskError(SimEnvError, ValueError):
    """An action mask, or a list of choices, does not fit the action space."""


class RewardError(SimEnvError, ValueError):
    """A reward is not one finite number."""


class NoDecisionError(SimEnvError, RuntimeError):
    """The simulation came to its end without asking for a decision."""


class ResetNeededError(SimEnvError, RuntimeError):
    """There is no episode to go on with; ``reset`` begins one."""


class NotResetError(ResetNeededError):
    """The environment was used before its first ``reset``."""


class EpisodeOverError(ResetNeededError):
    """The episode has ended, or an error has ended it."""


class ClosedError(ResetNeededError):
    """The environment was closed."""


class ReentrancyError(SimEnvError, RuntimeError):
    """An environment was stepped, reset or closed while its own simulation was moving."""


class WrongThreadError(SimEnvError, RuntimeError):
    """A simulation is in another thread or process, or a thread that it has started was to decide something."""


class WorkerError(SimEnvError, RuntimeError):
    """A process with simulations in it died, or something was raised there that cannot be told here as it was."""


class ProcessError(SimEnvError, RuntimeError):
    """Something went wrong with a simulator in another process; the leaf says what."""


class ProcessDiedError(ProcessError, ChildProcessError):
    """The process could not be started, has ended, or has closed its pipe."""


class ProcessTimeoutError(ProcessError, TimeoutError):
    """The process has not answered in time, or has not read what it was sent."""


class RemoteError(ProcessError):
    """The model in the process has raised an error. Its text stands here; nothing of it is imported."""


class WireError(ProcessError, ValueError):
    """The process has sent, or was to be sent, what the wire does not allow."""


class StoreError(SimEnvError, OSError):
    """The store of an experiment cannot be read or written. What was stored before stays as it is."""


class MissingExtraError(SimEnvError, ImportError):
    """A package is missing that one of the extras installs."""


class CheckFailedError(SimEnvError, AssertionError):
    """A check of a simulation has found what must not be. Its message is what was found."""
