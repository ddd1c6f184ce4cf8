"""The life cycle of episodes: plans, drivers, sessions, episodes and agents.

Each module imports only from those below it::

    branching                   exact continuations of an episode
    provenance                  the record of what an environment was made of
    session                     the simulation of one environment, over all its episodes
    episode                     one episode, and the life cycle of a decision
    rounds, run                 rounds of the parallel and joint views; the run on the simulation's stack
    plan                        the checked description of an environment
    agent, roster               one agent; who decides where
    threads                     the driver that runs a simulation in a thread
    planner, greenlets          policies that get the environment; the driver that runs a simulation in a greenlet
    point                       decision points and other events
    driver                      the switch between a simulation's stack and its user's; what a simulation has opened
    context, points             the user's side, with its global generators; points by their names
    actions                     checks of actions
    spaces, stacking            casts and checks of single values; stacks of many
    rng, options, packing       seeds of generators; options; pickles for other processes
"""
