"""Copies of an environment in mid-episode, in forked processes or by replays.

A clone mirrors its episode here, so that views know nothing of processes. Nothing in the other
folders of the core knows of copies.
"""
