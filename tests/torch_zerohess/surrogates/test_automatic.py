"""The automatic surrogate chooses what the evaluations are like."""

import torch

from torch_zerohess.surrogates import automatic
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


def test_lengths_are_chosen_once_and_models_compared_on_a_thousand_evaluations(monkeypatch):
    """The fit that is compared has the kernel, the lengths and the noise of the fit that is kept."""
    z, given, honest = 2 * normal(1500, 1), [], ProcessSurrogate.given

    def recorded(self, points, outputs):
        given.append((self, len(points), honest(self, points, outputs)))
        return given[-1][2]

    monkeypatch.setattr(ProcessSurrogate, "given", recorded)
    surrogate = AutomaticSurrogate()
    surrogate.fit(z, z.sin())
    ((kept, count, compared),) = given
    assert surrogate.model is kept
    assert count == 800
    assert torch.equal(kept.lengths, compared.lengths)
    assert (kept.process.kernel, kept.process.noise) == (compared.process.kernel, compared.process.noise)
    torch.testing.assert_close(compared(z[:50]), z[:50].sin(), atol=0.01, rtol=0)


def test_an_affine_map_is_kept_where_a_process_is_hardly_better():
    """Of an affine map in noise both leave the noise, and of a curve the process leaves far less."""
    z, noise = normal(300, 2), 0.3 * normal(300, 5, seed=1)
    for seed in range(3):
        surrogate = AutomaticSurrogate()
        surrogate.fit(z, z @ normal(2, 5, seed=seed) + noise.roll(seed, 0))
        assert isinstance(surrogate.model, LinearSurrogate)
    surrogate.fit(z, (2.0 * z).sin() @ normal(2, 5) + 0.1 * noise)
    assert isinstance(surrogate.model, ProcessSurrogate)


def test_a_sparse_map_is_tried_on_a_few_elements_of_dense_outputs(monkeypatch):
    """Of 50 parameters: at first 64 elements of the latest 100 outputs. A sparse map is then fitted to all of them."""
    sizes, honest = [], automatic.SparseSurrogate.fit

    def recorded(self, points, outputs):
        sizes.append((*points.shape, outputs[0].numel()))
        honest(self, points, outputs)

    monkeypatch.setattr(automatic.SparseSurrogate, "fit", recorded)
    z, surrogate = normal(400, 50), AutomaticSurrogate()
    surrogate.fit(z, z @ normal(50, 300, seed=1) + normal(400, 300, seed=2))
    assert sizes == [(100, 50, 64)]
    assert isinstance(surrogate.model, LinearSurrogate)
    surrogate.fit(z, z[:, :3].repeat(1, 100))
    assert sizes[1:] == [(100, 50, 64), (400, 50, 300)]
    assert isinstance(surrogate.model, automatic.SparseSurrogate)


def test_a_sparse_map_that_leaves_about_as_much_on_a_few_elements_is_tried_on_all(monkeypatch):
    """With half as many outputs as parameters neither map explains much: the few elements do not tell."""
    tried, honest = [], automatic.SparseSurrogate.fit

    def recorded(self, points, outputs):
        tried.append(outputs[0].numel())
        honest(self, points, outputs)

    monkeypatch.setattr(automatic.SparseSurrogate, "fit", recorded)
    z, surrogate = normal(20, 200), AutomaticSurrogate()
    surrogate.fit(z, z @ normal(200, 300, seed=1))
    assert tried == [64, 300]
