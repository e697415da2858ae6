"""Lines on how far a search is, to stderr."""

import sys

_PAUSE = 1.0
"""Seconds between two lines."""


class Report:
    """Lines of a search that began at a time in seconds, if it is `verbose`."""

    def __init__(self, begun: float, *, verbose: bool) -> None:
        self.verbose = verbose
        """Whether there are lines."""
        self._said = begun

    def due(self, now: float) -> bool:
        """Return whether a line is due at a time: a second after the last one that was due."""
        if not self.verbose or now - self._said < _PAUSE:
            return False
        self._said = now
        return True

    def say(self, evaluations: int, value: float, sigma: float, seconds: float) -> None:
        """Write a line."""
        said = f"{evaluations} evaluations, value {value:.6g}, sigma / its start {sigma:.3g}, {seconds:.0f} s"
        print(said, file=sys.stderr, flush=True)
