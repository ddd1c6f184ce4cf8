"""The life of an environment: sessions, their episodes, and the agents of these.

``episode.py`` alone determines the order of events. The folder reads ``plans``, and moves a
simulation by ``switching``; views and ``copies`` use it.
"""
