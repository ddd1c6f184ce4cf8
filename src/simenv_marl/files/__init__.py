"""Files that people can read: lines of JSON, values in them, names of objects, tapes of episodes.

``save_episode`` and ``load_episode`` are in ``simenv_marl.episodes``, because they make views.
"""
