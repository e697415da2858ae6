"""Tensors that the caller made on the CPU stay there, and give the same bits, whatever the default device of torch.

On "meta" a tensor has no numbers: one that was made there by mistake ends the run with an error.
"""

import numpy as np
import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.estimation import student, surrogate_mean
from truths import vector

X = torch.stack([vector(0.3, -0.4), vector(0.1, 0.2), vector(0.5, 0.6)])
W = torch.stack([vector(1.0, 0.5), vector(0.2, -0.7), vector(0.3, 0.3)])
ZEROS = vector(0.0, 0.0)


def picture(z):
    return torch.sin(z @ W.mT)


def estimated():
    found = []
    for settings in ({}, {"sampler": "sobol"}, {"sampler": "orthogonal"}, {"proposal": "optimal"}):
        one = zh.estimate(picture, X, zh.Smoothing(sigma=0.3, samples=8, seed=0, **settings), value="smoothed")
        found += [one.value, one.gradient, one.hessian(), one.standard_error("gradient")]
    return found


def estimated_until_accurate():
    smoothing = zh.Smoothing.auto(sigma=0.3, samples=8, seed=0)
    return [zh.estimate(picture, X[0], smoothing, tolerance=0.5, max_evaluations=100).gradient]


def estimated_from_numbers():
    """Settings and outputs that are no tensors; a point that is dropped; a seed of torch."""
    torch.manual_seed(5)
    smoothing = zh.Smoothing(sigma=[0.3, 0.2], samples=8)
    fns = (
        lambda z: [float(one.sum()) for one in z],
        lambda z: np.sin(z.numpy()),
        lambda z: [int(one.sum() > 0) for one in z],
        lambda z: torch.where(z[:, 0] > 1, torch.nan, z.sum(1)),
    )
    return [zh.estimate(fn, X, smoothing, on_nonfinite="drop").gradient for fn in fns]


def layer_with_a_memory():
    layer = zh.BlackBox(
        lambda z: picture(z).numpy(), zh.Smoothing(sigma=0.3, samples=4, seed=3), memory=zh.Memory(fresh=2, draws=32)
    )
    x, found = X.clone().requires_grad_(), []
    for _ in range(3):
        y = layer(x)
        (slope,) = torch.autograd.grad((y * y).sum(), x)
        found += [y.detach(), slope]
        x = (x.detach() - 0.1 * slope).requires_grad_()
    return found


def minimized(**settings):
    fit = zh.minimize(
        settings.pop("fn", picture), ZEROS, **{"sigma": 0.5, "seed": 0, "max_evaluations": 20, **settings}
    )
    return [fit.points, fit.values, fit.x, fit.gradient, fit.hessian]


def minimized_in_a_box():
    return minimized(loss=lambda y: y.square().sum(), bounds=[(-1, 1), (None, 2)], batch=3)


def minimized_in_a_full_box():
    return minimized(fn=lambda z: (z - 0.3).square().sum(1).tolist(), bounds=(-1, 1))


def minimized_in_noise():
    generator = torch.Generator().manual_seed(0)

    def noisy(z):
        noise = torch.randn(len(z), generator=generator, dtype=torch.float64, device="cpu")
        return z.square().sum(1) + 0.1 * noise

    return minimized(fn=noisy, max_evaluations=40)


@pytest.mark.parametrize(
    "run",
    [
        estimated,
        estimated_until_accurate,
        estimated_from_numbers,
        layer_with_a_memory,
        minimized_in_a_box,
        minimized_in_a_full_box,
        minimized_in_noise,
    ],
)
def test_the_default_device_changes_nothing(run):
    plain = run()
    surrogate_mean._even.cache_clear()
    student._gauss_legendre.cache_clear()
    torch.set_default_device("meta")
    try:
        other = run()
    finally:
        torch.set_default_device(None)
    for a, b in zip(plain, other, strict=True):
        assert torch.equal(a, b)
