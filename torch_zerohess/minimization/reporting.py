"""Lines on how far a search is, to stderr."""

import sys
import time

_PAUSE = 1.0
"""Seconds between two lines."""


class Reporting:
    """Lines of a search that is `verbose`; otherwise none."""

    def __init__(self, *, verbose: bool) -> None:
        self.verbose = verbose
        """Whether there are lines."""
        self._said = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether the last line was a second ago."""
        return self.verbose and time.monotonic() - self._said >= _PAUSE

    def say(self, evaluations: int, value: float, sigma: float, seconds: float) -> None:
        """Write a line."""
        self._said = time.monotonic()
        said = f"{evaluations} evaluations, value {value:.6g}, sigma / its start {sigma:.3g}, {seconds:.0f} s"
        print(said, file=sys.stderr, flush=True)
