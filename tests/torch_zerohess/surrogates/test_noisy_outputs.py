"""Derivatives of a loss from noisy outputs, against automatic derivatives of outputs that are known."""

import torch
from searches import sum_of_squares

from torch_zerohess.surrogates import noisy_derivatives
from torch_zerohess.surrogates.noisy_outputs import OutputRegression
from truths import normal, vector

NOISE = 0.1
TIMES = torch.linspace(0, 1, 12, dtype=torch.float64)
TARGET = torch.cos(3 * TIMES)
X, OTHER = vector(0.4, 1.0), vector(0.9, 0.6)


def image(z):
    return torch.exp(-z[..., :1] * TIMES) * z[..., 1:]


loss = sum_of_squares(TARGET)


def logs(y):
    return torch.log1p((y - TARGET).square()).sum()


def told(seed, white_box, count=80):
    points = X + 0.5 * normal(count, 2, seed=seed)
    outputs = image(points) + NOISE * normal(count, 12, seed=seed + 1000)
    return OutputRegression(points, outputs, white_box, torch.Size([12]))


def test_derivatives_and_changes_and_their_errors():
    """Over 24 sets of outputs, (estimate - truth) / error has a size between 0.4 and 2: numbers err together."""
    slope = torch.func.grad(lambda z: logs(image(z)))(X)
    bend = torch.func.hessian(lambda z: logs(image(z)))(X)
    rise = float(logs(image(OTHER)) - logs(image(X)))
    scores = []
    for seed in range(24):
        model, width = told(seed, logs).derivatives(X)
        change, error = told(seed, logs).change(X, OTHER)
        gradient, hessian = model.gradient / width, (model.hessian / (width[:, None] * width)).diagonal()
        own = model.gradient_error / width, model.curvature_error / width**2
        off = [(gradient - slope) / own[0], (hessian - bend.diagonal()) / own[1], vector((change - rise) / error)]
        scores.append(torch.cat(off))
    rms = torch.stack(scores).square().mean(0).sqrt()
    assert bool((rms < 2.0).all())
    assert bool((rms > 0.4).all())


def test_curvature_of_outputs_is_in_the_hessian():
    """Without noise the Hessian is exact also where the residuals are large."""
    points = X + 0.05 * normal(60, 2)
    regression = OutputRegression(points, image(points), loss, torch.Size([12]))
    model, width = regression.derivatives(X)
    truth = torch.func.hessian(lambda z: loss(image(z)))(X)
    torch.testing.assert_close(model.hessian / (width[:, None] * width), truth, rtol=1e-2, atol=1e-2)
    torch.testing.assert_close(model.value, float(loss(image(X))), rtol=1e-4, atol=0)


def test_few_or_equal_points_tell_nothing():
    regression = told(0, loss, count=10)
    assert regression.derivatives(X) is None
    assert regression.change(X, OTHER) is None
    same = OutputRegression(X.expand(40, -1), image(X).expand(40, -1), loss, torch.Size([12]))
    assert same.derivatives(X) is None


def test_values_far_away_do_not_count():
    """A thousand outputs of another function at a distance of ten widths."""
    near, far = told(0, loss, count=100), normal(100, 2, seed=5)
    points = torch.cat([near.points, X + 10 * far / far.norm(dim=1, keepdim=True)])
    outputs = torch.cat([near.outputs, 50 * normal(100, 12, seed=6)])
    both = OutputRegression(points, outputs, loss, torch.Size([12]))
    model, width = both.derivatives(X)
    alone, unit = near.derivatives(X)
    torch.testing.assert_close(model.gradient / width, alone.gradient / unit, rtol=0.2, atol=0.2)


def test_many_outputs_are_thinned(monkeypatch):
    monkeypatch.setattr(noisy_derivatives, "_MOST", 40)
    seen = []
    own = noisy_derivatives.process_features

    def process_features(u, *rest):
        seen.append(len(u))
        return own(u, *rest)

    monkeypatch.setattr(noisy_derivatives, "process_features", process_features)
    assert told(0, loss, count=150).derivatives(X) is not None
    assert max(seen) <= 40
