"""Imports packages of the extras when they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import MissingExtraError


def needed(module: str, what: str, *, extra: str) -> Any:
    """Import a module that an extra installs.

    Args:
        module: The dotted name of the module.
        what: The feature that needs it, for the error message.
        extra: The extra that installs it.

    Raises:
        MissingExtraError: The module is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtraError(f"{what} needs {package}: install simenv-marl[{extra}] ({error})") from None
