"""The packages that experiments need beside the core, and which are imported when they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import MissingExtraError


def needed(module: str, what: str) -> Any:
    """A module of an extra.

    Args:
        module: Its dotted name.
        what: What needs it.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtraError(f"{what} needs {package}: install simenv-marl[experiments] ({error})") from None
