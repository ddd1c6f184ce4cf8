"""What happens in an environment: sessions, their episodes, and the agents of these.

``episode.py`` alone tells what happens when. The folder reads ``plans``, and moves a simulation by
``switching``; views and ``copies`` use it.
"""
