"""How control switches between a simulation's stack and its user's, and what both sides share.

It knows hooks and events, but nothing of decisions, agents or episodes. The other folders of the
core use it; it uses none of them.
"""
