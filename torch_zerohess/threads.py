"""One thread for many small operations, which several threads slow down: they wait for each other after every one.

On two busy cores, steps of a search by a Gaussian process of 18 outputs take 10 to 20 times as long with two threads of
torch as with one.
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

    Only in the main thread of Python. Other threads of Python keep the numbers that they have.
    """
    before = torch.get_num_threads()
    small = parameters <= _PARAMETERS and numbers <= _NUMBERS
    if before == 1 or not small or threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        torch.set_num_threads(1)
        _let_others_have(before)
        yield
    finally:
        torch.set_num_threads(before)


def _let_others_have(count: int) -> None:
    """Give threads of Python that begin during the step a number of threads of torch, which they keep for good.

    Torch holds a number for each thread of Python. A new one takes what was set last, in whichever thread of Python.
    """
    other = threading.Thread(target=torch.set_num_threads, args=(count,))
    with contextlib.suppress(RuntimeError):  # no thread can begin, so none needs the number
        other.start()
        other.join()
