"""The black boxes that a process keeps: those that were used last, so that its memory is bounded."""

from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")

MOST = 4
"""Black boxes that a worker keeps, and whose pickled form the caller keeps."""


def used(kept: dict[K, V], key: K) -> V:
    """Return what is kept under a key; it is now the one that was used last."""
    value = kept[key] = kept.pop(key)
    return value


def make_room(kept: dict[K, V], most: int = MOST) -> list[K]:
    """Let go of what was not used for longest, until one more may be kept. Return the keys of what went."""
    gone = list(kept)[: max(0, len(kept) - most + 1)]
    for key in gone:
        del kept[key]
    return gone
