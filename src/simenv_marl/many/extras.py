"""Packages of the extras, which are imported when they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import MissingExtraError


def needed(module: str, what: str, *, extra: str) -> Any:
    """A module of an extra.

    Args:
        module: Its dotted name.
        what: What needs it.
        extra: The extra that installs it.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtraError(f"{what} needs {package}: install simenv-marl[{extra}] ({error})") from None
