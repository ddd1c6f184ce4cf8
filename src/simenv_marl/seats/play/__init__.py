"""``python -m simenv_marl play``: a page on which people decide in a running simulation."""

from .recording import replay

__all__ = ["replay"]
