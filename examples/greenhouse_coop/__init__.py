"""A greenhouse in which watering and ventilation learn to cooperate.

The example of the Sim-Env paper (supplements S1 and S2), extended by a second agent, in three modules::

    model    the domain model, which is independent of reinforcement learning
    env      the environments: observations, actions and rewards
    train    training and evaluation of two agents
"""
