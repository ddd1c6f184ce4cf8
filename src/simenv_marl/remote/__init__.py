"""Simulators outside Python: simulations whose models run in processes of their own.

::

    check      runs episodes of a simulator, and reports its errors
    process    ProcessSimulation: from frames to calls of decision functions, and back
    calls      the calls as mappings see them, and the functions that represent a simulator's points
    child      the process: starting it, its frames, waiting for it, ending it
    guardian   ends the processes of simulators when this process has ended
    callbacks  CallbackGuard: exceptions in callbacks of C code
    wire       lines, their JSON, and what frames may contain
"""

from .callbacks import CallbackGuard
from .process import ProcessSimulation

__all__ = ["CallbackGuard", "ProcessSimulation"]
