"""How a worker process begins, with one thread, and ends, with its parent."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_starting = threading.Lock()


def started_worker(
    target: Callable[["Connection[Any, Any]"], None], name: str, *, daemon: bool
) -> tuple[SpawnProcess, "Connection[Any, Any]"]:
    """Start a process that runs `target(connection)`, and return it with the other end of the connection."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=target, args=(theirs,), name=name, daemon=daemon)
    with _starting, _own_settings():
        process.start()
    theirs.close()
    return process, mine


@contextlib.contextmanager
def _own_settings() -> Iterator[None]:
    """Let a process that starts inside have one thread, and let Ctrl-C not reach it while it imports.

    Libraries read the variables when they are loaded, which may be before any code of this package runs there. So they
    are set here: multiprocessing gives a process no environment but that of its parent. A program that another thread
    starts meanwhile gets them, too. A new process blocks the signals that its parent blocks, until it calls
    `end_with_parent`.
    """
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    masks, blocked = hasattr(signal, "pthread_sigmask"), set[int]()
    if masks:
        resource_tracker.ensure_running()  # its start would end the blocking
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def end_with_parent() -> None:
    """Let this process, made by multiprocessing, and the programs that it starts end when its parent does, however.

    A thread waits for that. On Linux the kernel does too, because code that hangs may keep the thread from running: the
    parent holds the other end of a pipe, and SIGKILL is sent when that closes. Ctrl-C is left to the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # see `_own_settings`
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # a group for this process and the programs that it starts
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    if sys.platform == "linux":
        import fcntl

        fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, -os.getpid())  # to the group
        fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
        flags = fcntl.fcntl(parent.sentinel, fcntl.F_GETFL)
        fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, flags | os.O_ASYNC)


def _follow(sentinel: int) -> None:
    wait([sentinel])
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def end_group(pid: int) -> None:
    """Kill a process that leads a group, as one that called `end_with_parent`, and the programs that it started."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)


def ends_by_its_group() -> bool:
    """Return whether this process called `end_with_parent`: programs that it starts must stay in its group."""
    return multiprocessing.parent_process() is not None and hasattr(os, "getpgrp") and os.getpgrp() == os.getpid()


def end_tree(pid: int) -> None:
    """Kill a process, what it started, and what those started, where the system lists processes in /proc."""
    parents: dict[int, int] = {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it ended
            parents[int(file.parent.name)] = int(file.read_text(errors="replace").rpartition(")")[2].split()[1])
    tree = [pid]
    for one in tree:
        tree += [child for child, parent in parents.items() if parent == one]
    for one in tree:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(one, signal.SIGKILL)


def ending(code: int) -> str:
    """Return an exit code in words: a negative one is the number of the signal that ended the process."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
