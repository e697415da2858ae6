"""Black boxes at the top of a module, as worker processes need them."""

import copy
import os
import signal
import time
import types
import zlib
from pathlib import Path

import numpy as np
import torch

from torch_zerohess.evaluators.process_identity import own_seed
from torch_zerohess.evaluators.transfer import packed, unpacked


def waves(z, *aux):
    """[K, n] -> [K]; every row by itself has the same bits as in a batch."""
    return sum(((z**3).sin().sum(1), *(one.sum(1) for one in aux)))


def picture(z):
    """[K, n] -> [K, 48, 64, 3], far more than goes through a pipe in one message."""
    return (z.sum(1)[:, None, None, None] * torch.arange(48 * 64 * 3).reshape(48, 64, 3)).cos()


def with_numbers(z):
    """[K, n] -> [K, 2] and numbers of the points [K, 2]: two results."""
    return z.sin()[:, :2], torch.arange(len(z)).repeat(2, 1).mT.double()


def points(count: int, n: int = 3) -> torch.Tensor:
    return torch.rand(count, n, generator=torch.Generator().manual_seed(count), dtype=torch.float64)


def numbered(z):
    """Seed of the call whose number is the point: [K, 1] -> [K]."""
    return torch.tensor([own_seed(int(one), 2**31) for one in z[:, 0]], dtype=torch.float64)


class Reusing:
    """Sums of the coordinates and of aux [K], in one buffer for all calls; points and aux are lost."""

    def __init__(self, most: int) -> None:
        self.buffer = torch.empty(most)

    def __call__(self, z, aux):
        values = torch.sum(torch.cat([z, aux[:, None]], 1), 1, out=self.buffer[: len(z)])
        z.zero_()
        aux.zero_()
        return values


def of_one(point):
    """[n] -> a number of Python."""
    return float(point[0]) ** 2 - 0.5


def process(z):
    """Number of the process."""
    return torch.full((len(z),), float(os.getpid()), dtype=torch.float64)


def threads(z):
    """Threads of torch and of libraries that read the environment."""
    return torch.tensor([[torch.get_num_threads(), float(os.environ["OMP_NUM_THREADS"])]] * len(z))


def failing(z):
    """Raise at every point with a coordinate above one half."""
    if bool((z > 0.5).any()):
        raise ArithmeticError(f"no value above one half, got {float(z.max()):.3f}")
    return z[:, 0].clone()


def leaving(z):
    raise SystemExit("done")


class Odd(Exception):
    """An error that can be pickled, but not made again from what was pickled."""

    def __init__(self, what, why):
        super().__init__(what)


def odd(z):
    raise Odd("a", "b")


def ragged(z):
    """A shape that depends on the point."""
    return torch.zeros(len(z), 2 if bool((z[:, 0] > 0.5).any()) else 3)


def aborting(z):
    """End the process at every point with a first coordinate above one half, as a library that aborts."""
    if bool((z[:, 0] > 0.5).any()):
        os.abort()
    return (z**2).sum(1)


def never(z):
    os.abort()


class Dying:
    """End the process at every point, after a line in a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __call__(self, z):
        with self.file.open("a") as lines:
            lines.write("called\n")
        os._exit(3)


def hungry(z):
    """Take 300 MB for a moment."""
    return torch.ones(75_000_000).sum() * 0 + z[:, 0]


class Disturbed:
    """Waves, but each file of a folder makes one evaluation kill or terminate its process, or hang."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, z):
        for file in sorted(self.folder.iterdir()):
            try:
                file.unlink()
            except FileNotFoundError:  # another worker was faster
                continue
            if file.name.startswith("hang"):
                time.sleep(600)
            os.kill(os.getpid(), signal.SIGTERM if file.name.startswith("term") else signal.SIGKILL)
        return waves(z)


class Counted:
    """Makes a black box, and leaves a line for it in a file."""

    def __init__(self, file: Path) -> None:
        with file.open("a") as lines:
            lines.write(f"{os.getpid()}\n")
        self.unpicklable = lambda: None

    def __call__(self, z):
        return waves(z)


def broken():
    raise OSError("the scene is not there")


def asleep(z):
    """Hang, and keep every other thread of the process from running."""
    import ctypes

    print("asleep", flush=True)
    ctypes.PyDLL(None).sleep(600)


WAVE, GROWTH = (1.3, -0.4), (0.3, 0.9)
"""k and q of `wave_and_growth`."""


def wave_and_growth(z):
    """sin(k . z) + exp(q . z), [K, 2] -> [K]; a row by itself has the same bits as in a batch."""
    wave, growth = (sum(one * z[:, k] for k, one in enumerate(vector)) for vector in (WAVE, GROWTH))
    return wave.sin() + growth.exp()


def third(z):
    """Whether the hash of the bits of a point is divisible by three: [K, n] -> [K]."""
    return torch.tensor([zlib.crc32(one.double().contiguous().numpy().tobytes()) % 3 == 0 for one in z])


def aborting_at_every_third(z):
    """The same values, but the process ends at a third of the points."""
    if bool(third(z).any()):
        os.abort()
    return wave_and_growth(z)


class Meeting:
    """Waves, but an evaluation ends only when the evaluations of all points 0 to `count` - 1 have begun."""

    def __init__(self, folder: Path, count: int) -> None:
        self.folder, self.count = folder, count

    def __call__(self, z):
        (self.folder / str(int(z[0, 0]))).touch()
        until = time.monotonic() + 60
        while len(list(self.folder.iterdir())) < self.count:
            if time.monotonic() > until:
                raise TimeoutError("nobody came")
            time.sleep(0.01)
        return waves(z)


def part(values):
    """Values as they come from a worker."""
    return unpacked(packed([values]))[0]


def sloped():
    """Make a black box with gradients; it returns whether it is called with them."""
    x = torch.zeros(2, requires_grad=True)
    x.sin().sum().backward()
    return graded


def graded(z):
    """[K, n] -> [K]; it leaves gradients on."""
    values = torch.full((len(z),), float(torch.is_grad_enabled()))
    torch.set_grad_enabled(True)
    return values


def made_late(path):
    """Write a file, wait for half a second, and return a black box."""
    path.touch()
    time.sleep(0.5)
    return waves


def in_default_type(z):
    """Thirds [K], in the default type of torch."""
    return torch.full((len(z),), 1 / 3, dtype=torch.get_default_dtype())


def counting(fn):
    """Return fn, and a list to which every call appends how many points it is given, as its last argument."""
    calls = []

    def counted(*arguments):
        calls.append(len(arguments[-1]))
        return fn(*arguments)

    return counted, calls


class Scaled:
    """Points times a factor that the caller may change."""

    factor = 1.0

    def __call__(self, z):
        return self.factor * z.sum(1)


def forking(z):
    """Sums [K], after a fork whose child comes back first, by an error if a point is above one half."""
    child = os.fork()
    if not child and z.max() > 0.5:
        raise ValueError("in the child")
    if child:
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == int(z.max() > 0.5)
    return z.sum(1)


def with_processes(z):
    """Sums [K], by a process of its own."""
    loader = torch.utils.data.DataLoader(z, batch_size=len(z), num_workers=1)
    return next(iter(loader)).sum(1)


GENERATOR = np.random.default_rng(0)
PLACE = types.ModuleType("place")
PLACE.generator = torch.Generator().manual_seed(0)


class Noisy:
    """Noise by a generator of its own."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(0)

    def __call__(self, z):
        time.sleep(0.02)
        return z[:, 0] + torch.randn(len(z), dtype=z.dtype, generator=self.generator)


def noisy(z):
    time.sleep(0.02)
    return z[:, 0] + torch.from_numpy(GENERATOR.standard_normal(len(z)))


def noisy_of_one(point):
    return noisy(point[None])[0]


def noisy_elsewhere(z):
    time.sleep(0.02)
    return z[:, 0] + torch.randn(len(z), dtype=z.dtype, generator=PLACE.generator)


def noisy_late(z):
    import late_noise

    time.sleep(0.02)
    return z[:, 0] + torch.from_numpy(late_noise.GENERATOR.standard_normal(len(z)))


def noisy_with_numpy(z):
    time.sleep(0.02)
    return z[:, 0] + torch.from_numpy(np.random.standard_normal(len(z)))


def seeded():
    """Return a black box after a seed for the generator of NumPy, which all processes share."""
    np.random.seed(0)
    return noisy_with_numpy


class Common:
    """Common random numbers: every call draws from a copy of one generator."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(0)

    def __call__(self, z):
        time.sleep(0.02)
        draws = torch.randn(8, dtype=z.dtype, generator=self.generator.clone_state())
        return (z + draws).square().mean(1)


def common_late(z):
    """The same with a generator that comes with the first call."""
    import late_table

    time.sleep(0.02)
    draws = copy.deepcopy(late_table.GENERATOR).standard_normal(8)
    return (z + torch.from_numpy(draws)).square().mean(1)


class Tabulated:
    """A table that the first call draws."""

    def __init__(self) -> None:
        self.generator, self.table = np.random.default_rng(0), None

    def __call__(self, z):
        time.sleep(0.02)
        if self.table is None:
            self.table = torch.from_numpy(self.generator.standard_normal(8))
        return (z + self.table).square().mean(1)


class Restarted:
    """Common random numbers: every call gives the generator the same seed."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(1)

    def __call__(self, z):
        time.sleep(0.02)
        return (z + torch.randn(8, dtype=z.dtype, generator=self.generator.manual_seed(0))).square().mean(1)


class Paired:
    """Noise whose numbers come in pairs, of which the generator keeps the second one."""

    def __init__(self) -> None:
        self.generator = np.random.RandomState(0)

    def __call__(self, z):
        time.sleep(0.02)
        return z[:, 0] + self.generator.normal()


class AfterAWhile(Noisy):
    """Noise from the third call on."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def __call__(self, z):
        self.calls += 1
        if self.calls > 2:
            return super().__call__(z)
        time.sleep(0.02)
        return z[:, 0] + 10 * os.getpid() + self.calls
