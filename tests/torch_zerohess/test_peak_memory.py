"""The most memory that derivatives of a million parameters take: rows of noise are drawn again, not stored."""

import subprocess
import sys
from pathlib import Path

import pytest

STATUS = Path("/proc/self/status")
START = """
import sys

import torch

from torch_zerohess import BlackBox, Smoothing, estimate

PAIRS, MOST = 32, 12  # floats for each parameter, beyond the 64 points


def peak():
    # Not `ru_maxrss`: a new program begins with that of the process that started it.
    with open("/proc/self/status") as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))


def black_box(k):
    return lambda z: torch.tanh(z @ k)


def by_estimate(k):
    got = estimate(black_box(k), torch.zeros_like(k), Smoothing(sigma=0.1, samples=PAIRS, seed=0))
    return got.gradient, got.hvp(torch.ones_like(k))


def by_layer(k):
    x = torch.zeros_like(k, requires_grad=True)
    y = BlackBox(black_box(k), Smoothing(sigma=0.1, samples=PAIRS, seed=0))(x)
    (gradient,) = torch.autograd.grad(y, x, create_graph=True)
    return gradient, torch.autograd.grad(gradient, x, torch.ones_like(k))[0]


def floats(derivatives, n):
    k = torch.ones(n) / n**0.5
    before = peak()
    gradient, product = derivatives(k)
    taken = (peak() - before) / (n * k.element_size())
    assert gradient.isfinite().all() and product.isfinite().all() and gradient.abs().max() > 0
    return taken


torch.set_num_threads(1)
derivatives = globals()[sys.argv[1]]
floats(derivatives, 1000)  # what a first call loads
taken = floats(derivatives, 1_000_000) - 2 * PAIRS
assert -2 < taken <= MOST, taken
"""


@pytest.mark.skipif(not STATUS.exists(), reason="needs the peak of a process from Linux")
@pytest.mark.parametrize("derivatives", ["by_estimate", "by_layer"])
def test_a_million_parameters_take_twelve_floats_each_beyond_the_points(derivatives: str) -> None:
    done = subprocess.run([sys.executable, "-c", START, derivatives], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
