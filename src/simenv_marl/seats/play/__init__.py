"""``python -m simenv_marl play``: a page where people decide in a running simulation."""

from .recording import replay
from .start import play

__all__ = ["play", "replay"]
