"""Lines that a thread writes to stderr, as they come."""

from __future__ import annotations

import time


class Lines:
    """Args: capfd: pytest's."""

    def __init__(self, capfd):
        self._capfd, self._text = capfd, ""

    def read(self) -> list[str]:
        """All lines so far."""
        self._text += self._capfd.readouterr().err
        return self._text.splitlines()

    def wait_for(self, count: int, seconds: float = 30.0) -> list[str]:
        """The lines, once there are so many; or what there is after so long."""
        end = time.monotonic() + seconds
        while len(found := self.read()) < count and time.monotonic() < end:
            time.sleep(0.01)
        return found
