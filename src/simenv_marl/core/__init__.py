"""The life cycle of episodes: plans, drivers, sessions, episodes and agents.

Each module imports only from those below it::

    clone                       copies of an environment in mid-episode, and exact continuations
    mirror, host                a clone, as its view sees it, and in its process
    provenance                  the record of what an environment was made of
    session                     the simulation of one environment, over all its episodes
    episode, plan               one episode, and the life cycle of a decision; the checked description of an environment
    rounds                      the rounds of parallel and joint views
    agent                       one agent of an episode
    split                       calls that hold many decisions
    point                       decision points and other events
    greenlets, threads          the two drivers: a simulation runs in a greenlet, or in a thread
    driver                      the switch between a simulation's stack and its user's; what a simulation has opened
    context, points             the user's side, with its global generators; points, agents and policies by their names
    policies                    policies that are asked one decision at a time
    actions, pending            checks of actions; a pending decision, as policies and people get it
    awaiting                    the thread in which coroutines of policies run
    spaces, stacking            casts and checks of single values; stacks of many
    rng, options, packing       seeds of generators; options; pickles for other processes
    forks, separation           forked processes, which end with the first one; what separates them from it
"""
