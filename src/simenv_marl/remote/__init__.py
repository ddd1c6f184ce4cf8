"""Simulators outside Python: simulations whose models run in other processes.

::

    check      check_wire: tests whether a simulator follows the protocol
    process    ProcessSimulation: starts a simulator and runs its episodes
    calls      the calls of an episode, as mappings receive them, and the decision functions
    child      the process: starting it, sending and receiving frames, ending it
    guardian   ends the processes of simulators when this process has ended
    callbacks  CallbackGuard: exceptions in callbacks of C code
    wire       the protocol: frames, their JSON, and their checks
"""

from .callbacks import CallbackGuard
from .process import ProcessSimulation

__all__ = ["CallbackGuard", "ProcessSimulation"]
