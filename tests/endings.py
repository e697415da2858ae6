"""Whether a process has ended, whoever started it."""

import time
from pathlib import Path


def alive(pid: int) -> bool:
    """Return whether any thread of a process runs; one that has ended may not be forgotten yet."""
    try:
        threads = list(Path(f"/proc/{pid}/task").iterdir())
        return len(threads) > 1 or threads[0].joinpath("stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def ends(pid: int) -> bool:
    """Return whether a process ends within a minute."""
    until = time.monotonic() + 60
    while alive(pid) and time.monotonic() < until:
        time.sleep(0.02)
    return not alive(pid)
