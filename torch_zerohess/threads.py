"""One thread for many small operations, which several threads slow down: they wait for each other after every one.

On two busy cores, steps of a search by a Gaussian process of 18 outputs take 20 times as long with two threads of torch
as with one.
"""

import contextlib
import threading
from collections.abc import Iterator

import torch

_PARAMETERS, _NUMBERS = 32, 4096
"""Parameters, and numbers of an output, up to which the operations of a step are small."""


@contextlib.contextmanager
def one_thread(parameters: int, numbers: int) -> Iterator[None]:
    """Let torch use one thread if a step with so many parameters and numbers of an output is small.

    The number of threads is a setting of the whole process, so only its main thread changes it, and sets it back.
    """
    before = torch.get_num_threads()
    small = parameters <= _PARAMETERS and numbers <= _NUMBERS
    if before == 1 or not small or threading.current_thread() is not threading.main_thread():
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
