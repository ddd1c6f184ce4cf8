"""The errors of this library: one root, and subclasses that are also the builtin errors that Python users expect.

::

    SimEnvError
    |-- DefinitionError      (ValueError)    a definition that cannot work
    |-- SimulationError      (TypeError)     an object that is not a simulation
    |-- UnknownPointError    (LookupError)   a decision point that does not exist
    |-- PatchError           (TypeError)     a function that cannot be replaced
    |-- UnknownTargetError   (LookupError)   a function to extend that does not exist
    |-- HandlerError         (ValueError)    a handler that does not fit, or is not attached
    |-- AgentError           (ValueError)    names of agents that clash or are not strings
    |-- UnknownAgentError    (LookupError)   an agent that the environment does not know
    |-- ViewError            (ValueError)    a view that these decision points do not allow
    |-- CopyError            (TypeError)     a vector environment that cannot be copied
    |-- BranchError          (RuntimeError)  a branch of an episode that cannot be made, or died
    |-- UnknownOptionError   (TypeError)     an option that does not exist
    |-- OptionValueError     (ValueError)    an option with an invalid value
    |-- InvalidActionError   (ValueError)    an illegal action; the simulation has not moved
    |-- ObservationError     (ValueError)    an observation that does not fit its space
    |-- MaskError            (ValueError)    a mask that does not fit its action space
    |-- RewardError          (ValueError)    a reward that is not a finite number
    |-- NoDecisionError      (RuntimeError)  an episode without a decision
    |-- ResetNeededError     (RuntimeError)  there is no running episode
    |   |-- NotResetError                    ... because there was no reset yet
    |   |-- EpisodeOverError                 ... because it has ended or failed
    |   `-- ClosedError                      ... because the environment was closed
    |-- ReentrancyError      (RuntimeError)  an environment that is used while its simulation runs
    |-- WrongThreadError     (RuntimeError)  a simulation or decision in the wrong thread or process
    |-- MissingExtraError    (ImportError)   a package of an extra that is not installed
    |-- ProcessError         (RuntimeError)  an error of a simulator in another process
    |   |-- ProcessDiedError    (ChildProcessError)  ... the process did not start, or has ended
    |   |-- ProcessTimeoutError (TimeoutError)  ... the process did not answer or read in time
    |   |-- RemoteError                         ... the model in the process raised an error
    |   `-- WireError           (ValueError)    ... a message that the wire does not allow
    |-- StoreError           (OSError)       a store of an experiment that cannot be read or written
    |-- WorkerError          (RuntimeError)  a worker that died, or an error that cannot be pickled
    `-- CheckFailedError     (AssertionError) a simulation that failed a check

Every error has its message as the only argument, so that it can be pickled.
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
"""The largest number of characters of a value in a message."""

_repr = reprlib.Repr()
_repr.maxlist = _repr.maxtuple = _repr.maxset = _repr.maxfrozenset = _repr.maxdict = _repr.maxdeque = 20
_repr.maxstring = _repr.maxother = _repr.maxlong = LONGEST


def shown(value: Any, longest: int = LONGEST) -> str:
    """Return a short text of a user's value for a message, even if its ``repr`` fails."""
    try:
        text = _repr.repr(value)
    except Exception:  # for example of an integer of many thousand digits
        text = object.__repr__(value)
    return text if len(text) <= longest else f"{text[: longest - 23]}...{text[-20:]}"


def meant(name: object, known: Iterable[str], beneath: str = "") -> str:
    """Return a hint for a message about an unknown name.

    Args:
        name: The unknown name.
        known: The names that exist.
        beneath: A prefix for each of these, such as "package.".

    Returns:
        "; did you mean this or that?", or an empty string if no known name is close.
    """
    close = get_close_matches(name, known, n=3) if isinstance(name, str) else []
    return f"; did you mean {' or '.join(beneath + other for other in close)}?" if close else ""


def text_of(error: BaseException) -> str:
    """Return the text of an error, even if its ``str`` fails."""
    try:
        return str(error)
    except Exception:
        return "its text cannot be told"


def told(error: BaseException) -> str:
    """Return the class and the text of an error."""
    return f"{type(error).__name__}: {text_of(error)}"


def notes_of(error: BaseException) -> list[str]:
    """Return the notes of an error, even if its ``__notes__`` is not a list."""
    notes = None
    with suppress(Exception):
        notes = error.__notes__
    return [note for note in notes if isinstance(note, str)] if isinstance(notes, (list, tuple)) else []


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the innermost line outside this package."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)


def annotate(error: BaseException, note: str) -> None:
    """Add a note to an error, even if it is immutable, as a frozen dataclass."""
    try:
        error.add_note(note)
    except Exception:
        with suppress(Exception):  # better an error without its note than another error
            notes = vars(error).setdefault("__notes__", [])
            if isinstance(notes, list):
                notes.append(note)


def close_after(error: BaseException, close: Callable[[], None], what: str) -> None:
    """Close something after an error. If closing fails, too, the first error stays the one that is raised."""
    try:
        close()
    except Exception as problem:
        annotate(error, f"simenv_marl: and {what}, when it was closed, raised {shown(problem)}")


def clear_frames(error: BaseException) -> None:
    """Clear this package's frames in an error's traceback, which may hold arguments of the model."""
    trace = error.__traceback__
    while trace is not None:
        frame, trace = trace.tb_frame, trace.tb_next
        if frame.f_code.co_filename.startswith(_PACKAGE):
            with suppress(RuntimeError):  # the frame is still running
                frame.clear()


class SimEnvError(Exception):
    """The root of all errors that this library raises."""


class DefinitionError(SimEnvError, ValueError):
    """A definition of a decision point cannot work."""


class SimulationError(SimEnvError, TypeError):
    """An object is not a simulation, or a simulation does something forbidden."""


class UnknownPointError(SimEnvError, LookupError):
    """A decision point does not exist."""


class PatchError(SimEnvError, TypeError):
    """A function cannot be made a decision point, or be exposed to plugins."""


class UnknownTargetError(SimEnvError, LookupError):
    """A function to extend does not exist."""


class HandlerError(SimEnvError, ValueError):
    """A handler cannot be called like its target, its position does not exist, or it is not attached."""


class AgentError(SimEnvError, ValueError):
    """The names of agents clash, or the name of an agent is not a string."""


class UnknownAgentError(SimEnvError, LookupError):
    """The environment does not know an agent of that name."""


class ViewError(SimEnvError, ValueError):
    """The active decision points do not allow this view."""


class CopyError(SimEnvError, TypeError):
    """A vector environment cannot be copied or pickled."""


class BranchError(SimEnvError, RuntimeError):
    """A branch of an episode cannot be made, or died without an answer."""


class UnknownOptionError(SimEnvError, TypeError):
    """An option does not exist."""


class OptionValueError(SimEnvError, ValueError):
    """An option or argument has an invalid value."""


class InvalidActionError(SimEnvError, ValueError):
    """An action is not legal. The simulation has not moved; a legal action may follow."""


class ObservationError(SimEnvError, ValueError):
    """An observation does not fit its space."""


class MaskError(SimEnvError, ValueError):
    """An action mask, or a list of choices, does not fit the action space."""


class RewardError(SimEnvError, ValueError):
    """A reward is not one finite number."""


class NoDecisionError(SimEnvError, RuntimeError):
    """The simulation ended without asking for a decision."""


class ResetNeededError(SimEnvError, RuntimeError):
    """There is no running episode; ``reset`` begins one."""


class NotResetError(ResetNeededError):
    """The environment was used before its first ``reset``."""


class EpisodeOverError(ResetNeededError):
    """The episode has ended, or an error has ended it."""


class ClosedError(ResetNeededError):
    """The environment was closed."""


class ReentrancyError(SimEnvError, RuntimeError):
    """An environment was stepped, reset or closed while its own simulation was running."""


class WrongThreadError(SimEnvError, RuntimeError):
    """A simulation is in another thread or process, or one of its own threads asked for a decision."""


class WorkerError(SimEnvError, RuntimeError):
    """A worker process died, or raised an error that cannot be sent to this process as itself."""


class ProcessError(SimEnvError, RuntimeError):
    """A simulator in another process failed. The subclass tells how."""


class ProcessDiedError(ProcessError, ChildProcessError):
    """The process did not start, has ended, or has closed its pipe."""


class ProcessTimeoutError(ProcessError, TimeoutError):
    """The process did not answer in time, or did not read a message in time."""


class RemoteError(ProcessError):
    """The model in the process raised an error. This error has its text; nothing of it is imported."""


class WireError(ProcessError, ValueError):
    """A message from or to the process breaks the rules of the wire."""


class StoreError(SimEnvError, OSError):
    """The store of an experiment cannot be read or written. What was stored before stays as it is."""


class MissingExtraError(SimEnvError, ImportError):
    """A package of one of the extras is missing."""


class CheckFailedError(SimEnvError, AssertionError):
    """A simulation failed a check. The message is the check's report."""
