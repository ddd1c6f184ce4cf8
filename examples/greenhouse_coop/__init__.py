"""A greenhouse in which watering and ventilation learn to cooperate.

The example of the Sim-Env paper (supplements S1 and S2), extended by a second agent: read
``model``, ``env``, ``train`` and ``plan`` in this order.
"""
