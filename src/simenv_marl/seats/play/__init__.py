"""A page on which people take agents' seats in a running simulation: ``python -m simenv_marl play``."""

from .recording import replay

__all__ = ["replay"]
