"""Simulators outside Python: simulations whose models run in processes of their own.

::

    check      plays episodes with a simulator, and reports its errors
    process    ProcessSimulation: from frames to calls of decision functions, and back
    calls      the calls as mappings see them, and the functions that represent a simulator's points
    kept       keeps processes while many simulations run one after the other
    child      the process: starting it, waiting for it, ending it; its lines
    wire       lines and frames
"""

from .callbacks import CallbackGuard
from .process import ProcessSimulation

__all__ = [
    "CallbackGuard",
    "ProcessSimulation",
]
