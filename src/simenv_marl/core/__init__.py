"""The life cycle of episodes: plans, drivers, sessions, episodes and agents.

Each module imports only from those below it::

    processes, provenance       pickling for other processes; the record of what an environment was made of
    session                     the simulation of one environment, over all its episodes
    episode                     one episode, and the life cycle of a decision
    ending                      the end of an episode
    participants                the agents of an episode
    plan                        the checked description of an environment
    drivers                     the drivers by name
    greenlets, threads          the two drivers: a simulation runs in a greenlet, or in a thread
    switch                      the switch between a simulation's stack and its user's
    events                      the events that a simulation sends, and how an episode handles them
    children                    the threads, processes and sockets that a simulation opens
    contexts                    the context in which an environment's code runs on the user's side
    agent                       one agent of an episode: its rewards, observations and infos
    asking                      policies that ask for the environment
    bound                       decision points with the definitions of one environment
    variant                     a named variant of a model, for experiments
    points                      the decision points that ``points=`` names
    options                     the options of environments
    rng                         a state of the global random generators for each environment
    spaces, stacking            casts and checks of single values; stacks of many
"""
