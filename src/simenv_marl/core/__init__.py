"""What happens when: plans, the stacks of simulations, sessions, episodes and agents.

Each module imports only from those below it::

    processes, provenance       what crosses to other processes; what an environment was made of
    session                     a simulation over all episodes of one environment
    episode                     what happens when: the life cycle of a decision
    ending                      how an episode ends
    participants                the agents of an episode
    plan                        what an environment is made of, checked before anything runs
    drivers                     the drivers by name
    greenlets, threads          a simulation's stack: a greenlet, or a thread
    switch                      how a decision crosses between a simulation's stack and its user's
    events                      what comes from a simulation, and what becomes of it
    children                    the threads that a simulation starts
    contexts                    what is around all that runs for an environment on its user's side
    agent                       what an episode knows of one agent; rewards and observations
    asking                      policies that are given the environment
    bound                       decision points under an environment's definitions
    variant                     a model with all that an experiment changes, under one name
    points                      what ``points=`` names
    options                     the options of environments
    rng                         a state of the global generators for each environment
    spaces, stacking            casts and checks of single values; arrays of many
"""
