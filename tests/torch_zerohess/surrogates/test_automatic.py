"""The automatic surrogate chooses what the evaluations are like."""

import torch

from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from truths import normal


def test_many_parameters_get_an_affine_map() -> None:
    z, slope = normal(60, 40), normal(40, 3, seed=1)
    surrogate = AutomaticSurrogate()
    surrogate.fit(z, z @ slope + 1.0)
    assert isinstance(surrogate.model, LinearSurrogate)
    new = normal(5, 40, seed=2)
    torch.testing.assert_close(surrogate(new), new @ slope + 1.0, atol=1e-5, rtol=0)


def test_a_curve_gets_a_process() -> None:
    z = torch.linspace(-3, 3, 30, dtype=torch.float64)[:, None]
    surrogate = AutomaticSurrogate()
    surrogate.fit(z, z.sin())
    assert isinstance(surrogate.model, ProcessSurrogate)
    assert surrogate.space is None
    torch.testing.assert_close(surrogate(z + 0.05)[:-1], (z + 0.05).sin()[:-1], atol=1e-2, rtol=0)


def test_wide_outputs_go_through_coordinates() -> None:
    z = torch.linspace(-3, 3, 30, dtype=torch.float64)[:, None]
    outputs = (torch.cat([z.sin(), z.cos()], 1) @ normal(2, 100, seed=3)).unflatten(1, (10, 10))
    surrogate = AutomaticSurrogate()
    surrogate.fit(z, outputs)
    assert surrogate.space is not None
    assert surrogate.coordinates(z).shape == (30, 2)
    torch.testing.assert_close(surrogate(z), outputs, atol=0.05, rtol=0)
