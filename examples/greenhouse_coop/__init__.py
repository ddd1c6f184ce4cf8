"""A greenhouse, in which watering and ventilation learn to cooperate.

The showcase of the Sim-Env paper (supplements S1 and S2), taken one agent further, in three modules::

    model    the domain model, which stands on its own and knows nothing of reinforcement learning
    env      the environments: what is observed, decided and rewarded
    train    what two agents learn in them, and what it is worth
"""
