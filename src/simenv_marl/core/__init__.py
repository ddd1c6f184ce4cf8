"""The life cycle of episodes: plans, drivers, sessions, episodes and agents.

Each module imports only from those below it::

    branching                   exact continuations of an episode
    provenance                  the record of what an environment was made of
    session                     the simulation of one environment, over all its episodes
    episode                     one episode, and the life cycle of a decision
    rounds, run                 rounds of the parallel and joint views; the run on the simulation's stack
    delegation                  decisions that policies or the rule take
    plan                        the checked description of an environment
    agent, prototype, roster    one agent; a simulation made for inspection; who decides where
    greenlets, threads          the two drivers: a simulation runs in a greenlet, or in a thread
    planner                     policies that get the environment
    point, loops                decision points and other events; asyncio's loops of two stacks
    driver                      the switch between a simulation's stack and its user's
    context, points, resources  the user's side; points by their names; what a simulation has opened
    actions, reseeding          checks of actions; seeds for a simulation's own generators
    spaces, stacking            casts and checks of single values; stacks of many
    rng, options, packing       global generators; options; pickles for other processes
    forking, reuse              what a forked process needs; processes that serve several simulations
"""
