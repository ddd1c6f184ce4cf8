"""The packages that experiments need besides the core."""

from __future__ import annotations

from functools import partial

from ..many.extras import needed as needed_of

needed = partial(needed_of, extra="experiments")
