"""Seats: people and language models decide in a running simulation.

``describe`` and ``parse`` put a pending decision into words, and words into an action. Policies
that are slow or fail are wrapped: ``FallbackPolicy`` answers for them, and ``RecordedPolicy``
repeats their answers.
"""

from ..core import Decision
from .answers import parse
from .descriptions import describe, free_text
from .language import LanguageModelPolicy
from .policies import FallbackPolicy, RecordedPolicy

__all__ = [
    "Decision",
    "FallbackPolicy",
    "LanguageModelPolicy",
    "RecordedPolicy",
    "describe",
    "free_text",
    "parse",
]
