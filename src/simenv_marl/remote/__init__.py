"""Simulators outside Python: a simulation whose model runs in a process of its own.

::

    check      plays episodes with a simulator, and says what it does wrong
    process    ProcessSimulation: from frames to calls of decision functions, and back
    calls      the calls as mappings see them, and the functions that stand for a simulator's points
    kept       processes that are kept while many simulations run one after the other
    child      the process: how it is started, waited for and ended; its lines
    wire       lines and frames
"""
