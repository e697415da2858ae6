"""Which process this is, for black boxes that draw random numbers of their own, or that fork.

A black box that is made in every worker counts its calls from the same seed in each of them. Its random numbers must
differ between workers, because estimates of noise compare repeated values.
"""

import hashlib
import os
import traceback
import uuid
from collections.abc import Callable
from typing import Any

_START = uuid.uuid4().hex
"""Of this process and of those that it forks; other processes, also on other machines, have others."""
_worker = False


def identity() -> str:
    """Return a name that no other process has."""
    return f"{_START}-{os.getpid()}"


def become_worker(caller: str = "") -> None:
    """Remember that this process evaluates black boxes for another one.

    caller: identity of the process that asks for values; nothing is remembered if it is this one.
    """
    global _worker
    _worker = _worker or caller != identity()


def is_worker() -> bool:
    """Whether this process evaluates black boxes for another one."""
    return _worker


def own_seed(seed: int, below: int) -> int:
    """Return the seed itself, or in a worker a pseudorandom one of 0 to below - 1 that depends on the process."""
    return digest(str(seed).encode()) % below if _worker else seed


def digest(data: bytes) -> int:
    """Return a pseudorandom number of 0 to 2^64 - 1 that depends on the data and on this process."""
    own = hashlib.blake2b(f"{identity()} ".encode() + data, digest_size=8)
    return int.from_bytes(own.digest(), "little")


def in_this_process(fn: Callable[..., Any], *args: Any) -> Any:
    """Return fn(*args). A process that fn forks, and that comes back from it too, ends: two would answer."""
    process = os.getpid()
    try:
        result = fn(*args)
    except BaseException as error:
        if os.getpid() != process:
            if isinstance(error, SystemExit) and isinstance(error.code, int | None):
                os._exit(error.code or 0)
            traceback.print_exc()
            os._exit(1)
        raise
    if os.getpid() != process:
        os._exit(0)
    return result
