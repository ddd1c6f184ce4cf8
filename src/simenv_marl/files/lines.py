"""Files with a line of JSON for each value."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class Lines:
    """A file with a line of JSON for each value. It is open only while it is read or written."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Name the file. The first line creates it."""
        self.path = Path(path)

    def read(self) -> Iterator[tuple[int, Any]]:
        """Yield the numbers of the lines, from 1, and their values.

        Lines that a crash has torn are left out.
        """
        for number, line in enumerate(self.path.read_bytes().splitlines(), 1):
            try:
                value = json.loads(line.decode(errors="surrogatepass"))
            except ValueError:
                continue
            yield number, value

    def append(self, *values: Any) -> None:
        """Append lines, in one call, so that processes can share the file.

        They begin on a new line, also where a crash or a full disk has torn the last one.
        """
        lines = [json.dumps(value, ensure_ascii=False) for value in values]
        text = "".join(f"{line}\n" for line in lines).encode()
        with open(self.path, "ab+", buffering=0) as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                text = text if file.read(1) == b"\n" else b"\n" + text
            file.write(text)
