"""Changes of a model that are in force while an environment or a block uses them."""

from __future__ import annotations

from collections.abc import Iterable

from .stacks import LOCK


class Patch:
    """A change of a model, in force while it has users. Subclasses define ``_apply`` and ``_revert``."""

    def __init__(self) -> None:
        self._users: set[object] = set()
        self._applied = False

    def install(self, user: object) -> None:
        """Change the model until every user has called ``uninstall``.

        Raises:
            PatchError: A place cannot be patched, or something else was set there meanwhile.
        """
        with LOCK:
            # Noted first: garbage collection may close another environment that uses it meanwhile.
            self._users.add(user)
            if self._applied:
                return
            try:
                self._apply()
                self._applied = True
            except BaseException:
                self.uninstall(user)
                raise

    def uninstall(self, user: object) -> None:
        """Undo ``install``; the last user restores the original. After an interrupt, call it again."""
        with LOCK:
            self._users.discard(user)
            if not self._users:
                self._applied = False
                self._revert()

    def _apply(self) -> None:
        """Change the model."""

    def _revert(self) -> None:
        """Undo ``_apply``, also where that failed half-way or was never called."""


class Installation:
    """Patches that stay installed until ``uninstall``, or until this object is garbage-collected.

    Attributes:
        complete: Whether nothing was restored yet.
    """

    __slots__ = ("_patches", "_user", "complete")

    def __init__(self, patches: Iterable[Patch]) -> None:
        """Install the patches; after an error, none of them stays installed."""
        self._user, self.complete = object(), True
        self._patches = list(patches)
        try:
            for patch in self._patches:
                patch.install(self._user)
        except BaseException:
            self.uninstall()
            raise

    def uninstall(self) -> None:
        """Restore the originals. After an interrupt, call it again; else garbage collection does."""
        self.complete = False
        while self._patches:
            self._patches[-1].uninstall(self._user)
            self._patches.pop()

    def __del__(self) -> None:
        if getattr(self, "_patches", ()):  # missing if an interrupt came in the constructor
            self.uninstall()
