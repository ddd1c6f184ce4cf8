"""What an environment is made of: its plan, with decision points, policies and options.

Everything here is a value that is checked before anything runs. The folder uses ``switching`` and
``values``; it knows nothing of episodes, which read it.
"""
