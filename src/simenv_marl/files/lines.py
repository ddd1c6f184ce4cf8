"""Files with a line of JSON for each value."""

import json
import os
from collections.abc import Iterator
from json.encoder import c_make_encoder, encode_basestring  # type: ignore[attr-defined]
from pathlib import Path
from typing import Any

# ``JSONEncoder.encode`` makes it for each line, which takes twice the time.
_chunks: Any = c_make_encoder(None, None, encode_basestring, None, ": ", ", ", False, False, True)


def to_line(value: Any) -> bytes:
    """Return a value as a line of JSON."""
    return f"{''.join(_chunks(value, 0))}\n".encode(errors="surrogatepass")


class Lines:
    """A file with a line of JSON for each value. It is open only while it is read or written."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Name the file. The first line creates it."""
        self.path = Path(path)
        self._name = os.fspath(path)  # because a ``Path`` is opened slowly

    def read(self) -> Iterator[tuple[int, Any]]:
        """Yield the numbers of the lines, from 1, and their values.

        Lines that a crash has torn are left out.
        """
        for number, line in enumerate(self.path.read_bytes().splitlines(), 1):
            try:
                value = json.loads(line.decode(errors="surrogatepass"))
            except (ValueError, RecursionError):
                continue
            yield number, value

    def append(self, *values: Any) -> None:
        """Append lines, in one call, so that processes can share the file.

        They begin on a new line, also where a crash or a full disk has torn the last one.
        """
        self._write(b"".join(map(to_line, values)), mends=True)

    def add(self, value: Any) -> None:
        """Append a line to a file that only this object writes."""
        self._write(to_line(value))

    def _write(self, text: bytes, mends: bool = False) -> None:
        file = os.open(self._name, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            if mends and os.lseek(file, 0, os.SEEK_END):
                os.lseek(file, -1, os.SEEK_END)
                text = text if os.read(file, 1) == b"\n" else b"\n" + text
            os.write(file, text)
        finally:
            os.close(file)
