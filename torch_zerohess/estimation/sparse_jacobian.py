"""The smoothed Jacobian of an output whose elements depend on few parameters each, from one batch of evaluations."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.estimation.inputs import check_no_derivative, checked_input, working
from torch_zerohess.estimation.likelihood_ratio import LikelihoodRatio
from torch_zerohess.estimation.nonfinite import finite_values
from torch_zerohess.estimation.perturbations import perturb
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.precision import without_autocast
from torch_zerohess.smoothing import Smoothing, check_smoothing
from torch_zerohess.surrogates.sparse_fit import SparseSettings, check_samples, fewest_samples, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_COUNTING = 0.5
"""Share of the samples that counts in any fit: weights of "aggregate" leave more than this."""
_LEAST = 0.05
"""`explained`, below which a Jacobian is useless: without noise its error is at least 97 % of its length."""
_OF_DENSE = 0.5
"""The same as a share of `explained_dense`. Where both are exact but for noise, they are nearly equal."""
_ROUNDING = 8 * torch.finfo(torch.float32).eps
"""Changes that are no larger than this share of the outputs may be rounding: there is nothing to explain."""


def sparse_jacobian(
    fn: Callable[..., Any],
    x: Tensor,
    smoothing: Smoothing,
    *,
    keep: int | None = None,
    rate: float = 0.1,
    grid: Sequence[int] | None = None,
    previous: SparseJacobian | None = None,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    on_nonfinite: str | float = "raise",
) -> SparseJacobian:
    """Estimate the Jacobian of fn, convolved with a Gaussian, at x [n], where each output depends on few parameters.

    All parameters are perturbed at once. Each output is regressed on the few parameters that its change is correlated
    with beyond chance. That takes about s log n samples for s parameters per output, whatever n: `estimate` needs many
    times n for the same error. Memory is O(m keep + n), m numbers per output, besides the points and the outputs.

    `explained` of the result says how much of the change of held-out outputs is predicted, with the support found
    anew without them; `explained_dense` the same for the Jacobian of least norm, which knows nothing of `previous`. If
    the first is not larger, outputs depend on many parameters each, or there are too few samples.

    Args:
        fn: [K, n] -> [K, *out], an image or another output of at least two numbers. Outputs of two dimensions or more
            are images, whose neighbouring pixels share evidence: [h, w], [*stack, h, w] as with channels first, and
            [*stack, h, w, channels] with up to four channels.
        x: [n], float32 or float64. An x that requires grad is taken as x.detach(), as by `estimate`.
        smoothing: how to sample; proposal "aggregate", "gaussian" or "uniform", sampler "random" or "orthogonal". For
            sampler "auto" it is "orthogonal" where `estimate` takes Sobol points. In many dimensions their coordinates
            are correlated, as if outputs depended on further parameters. Proposal "optimal" is refused because it
            draws samples for each parameter by itself: n evaluations and more, and so many determine the dense
            Jacobian. Proposal "fr22" is refused because no weight corrects it: its density vanishes where any u_i is
            0, so the weights prod_i sqrt(2/pi) / |u_i| have an infinite variance for every n. An antithetic pair is
            one sample, of which even orders of fn are gone. The baseline is not used: a constant is part of the
            regression.
        keep: parameters per output, at most; 16 if None, or n if that is less.
        rate: of false discoveries among the pairs of output and parameter that are found in a round; there are three.
            A pair that is false gets a small slope. Fewer than 1 / rate pairs count only if each of
            them is significant among all pairs.
        grid: rows and columns (and channels) in which the parameters lie, with n numbers in all. Neighbours then share
            evidence, which helps where outputs depend on patches of parameters.
        previous: an earlier Jacobian of the same shape, at an x nearby. Its support is tried first, and its slopes
            are the prior; held-out samples say how much they count. None of its own samples is drawn again: with a
            fixed seed the samples also depend on its `total_evaluations`.
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        on_nonfinite: "raise", "drop", or a number that replaces NaN and infinities.

    Raises ValueError or TypeError for an argument out of range, an output of one number, and fewer samples than the
    kept entries need. ValueError too if the weights of "uniform" leave too few samples that count, as they do in more
    than a few dimensions.

    Warns (UserWarning) if outputs change and the Jacobian is useless: `explained` is below 0.05 or below half of
    `explained_dense`.

    `standard_error` of the result allows for residuals whose variance depends on the perturbation, as it does for
    curved and for noisy fn. With few samples and strong curvature it is too small.

    Source: screening by correlation (Fan and Lv 2008), false discoveries by decoys (Barber and Candes 2015), standard
    errors of samples of different variance (HC3, MacKinnon and White 1985).

    Example:
        >>> x = torch.zeros(900).double()
        >>> blur = lambda z: torch.nn.functional.avg_pool2d(z.view(-1, 30, 30), 3, 1)  # [K, 28, 28], 9 texels each
        >>> J = sparse_jacobian(blur, x, Smoothing(sigma=0.1, samples=100, seed=0), grid=(30, 30))
        >>> seen = J.dense()[5, 7].view(30, 30)[5:8, 7:10]
        >>> J.evaluations, J.explained > 0.9, bool((seen - 1 / 9).abs().max() < 0.01)
        (200, True, True)
    """
    found, doubt = estimated(
        BlackBoxCall(fn, vectorized, evaluator, "smoothed", on_nonfinite),
        x,
        smoothing,
        {"keep": keep, "rate": rate, "grid": grid},
        previous,
    )
    if doubt:
        warnings.warn(doubt, UserWarning, stacklevel=2)
    return found


def estimated(
    call: BlackBoxCall, x: Tensor, smoothing: Smoothing, given: Mapping[str, Any], previous: SparseJacobian | None
) -> tuple[SparseJacobian, str]:
    """Return the Jacobian of `sparse_jacobian`, and why it is useless; "" if it is not.

    `given` are keep, rate and grid. The value of the call is "smoothed": f(x) itself is not evaluated.
    """
    check_smoothing(smoothing)
    check_no_derivative("a sparse Jacobian has no graph: use SparseBlackBox", x=checked_input(x))
    x = x.detach()
    if x.ndim != 1:
        raise ValueError(f"x must be one point [n], got {list(x.shape)}")
    smoothing = _resolved(smoothing, len(x))
    settings = replace(SparseSettings.checked(len(x), **given), prune=True, compared=True)
    check_samples(smoothing.samples, settings.keep)
    work = working(x)
    taken = previous.total_evaluations if isinstance(previous, SparseJacobian) else 0
    u, changes, weights, shape, evaluations, size = _sampled(call, work, smoothing, smoothing.drawn_seed(taken))
    check_samples(smoothing.samples, settings.keep, smoothing.samples - len(u))
    _check_weights(weights, smoothing, settings.keep)
    sigma = smoothing.sigma_vector(len(x), x.device).to(work)
    earlier = None if previous is None else _checked(previous, len(x), shape).to(work).times(sigma)
    with without_autocast(work.device):
        found = fit_sparse(u.to(work), changes.to(work), shape, settings, earlier, weights.to(work))
    varies = float(changes.abs().max()) > _ROUNDING * size
    doubt = _doubt(found, smoothing.samples) if varies else ""
    return replace(found.times(1.0 / sigma), evaluations=evaluations, total_evaluations=taken + evaluations), doubt


def _doubt(found: SparseJacobian, samples: int) -> str:
    """Return why the Jacobian of an output that changes is useless; "" if it is not."""
    if found.explained >= max(_LEAST, _OF_DENSE * found.explained_dense):
        return ""
    explained, dense = max(found.explained, 0.0), max(found.explained_dense, 0.0)
    return (
        f"explained = {explained:.2f} of the changes of the outputs, a dense Jacobian explains {dense:.2f}: the sparse "
        "Jacobian is useless, because the outputs depend on many parameters, or on none and have noise; take more "
        f"samples than {samples}, or BlackBox"
    )


def check_output(shape: torch.Size, other: str) -> None:
    """Raise ValueError for an output [*out] of one number, and name what is made for it."""
    if shape.numel() < 2:
        raise ValueError(
            f"fn must return an output of many numbers, each of few parameters, got shape {list(shape)}: for one "
            f"number use {other}"
        )


def _resolved(smoothing: Smoothing, n: int) -> Smoothing:
    """Return the settings without "auto"; ValueError for samples that do not determine a sparse Jacobian."""
    if smoothing.sampler == "auto" and smoothing.resolved(n).sampler == "sobol":
        smoothing = smoothing.replace(sampler="orthogonal")
    smoothing = smoothing.resolved(n)
    if smoothing.proposal in ("optimal", "fr22"):
        raise ValueError(
            f"proposal must be 'aggregate', 'gaussian' or 'uniform', got {smoothing.proposal!r}: 'optimal' evaluates "
            "more points than there are parameters, and the weights of 'fr22' have an infinite variance"
        )
    if smoothing.sampler == "sobol":
        raise ValueError(
            "sampler must be 'random', 'orthogonal' or 'auto', got 'sobol': in many dimensions the coordinates of "
            "Sobol points are correlated, as if outputs depended on further parameters"
        )
    return smoothing


def _sampled(
    call: BlackBoxCall, x: Tensor, smoothing: Smoothing, seed: int
) -> tuple[Tensor, Tensor, Tensor, torch.Size, int, float]:
    """Return perturbations [S, n] in units of sigma, changes [S, m], weights [S], the shape [*out], evaluations.

    The last is the largest magnitude of an output.
    """
    perturbations = perturb(x[None], smoothing, seed, keep=True)
    stein = perturbations.stein
    assert isinstance(stein, LikelihoodRatio)
    assert isinstance(stein.u, Tensor)
    points, u, weights = perturbations.points, stein.u[0], stein.weight[0]
    values, _ = call.values(points, [])
    shape = values.shape[2:]
    check_output(shape, "estimate")
    why = call.why_lost(points.shape[1])
    values, kept = finite_values(values, values, lambda: points, call.on_nonfinite, len(u), smoothing, stein, why)
    flat = values[0].reshape(len(u), -1).double()
    size = float(flat.abs().max())
    if smoothing.antithetic:
        S = len(u) // 2
        flat, u, weights = 0.5 * (flat[:S] - flat[S:]), u[:S], weights[:S]
    else:
        flat = flat - flat[:1]  # a small variation on a large offset keeps its digits
    if kept is not None:
        some = kept[0, : len(u)]
        flat, u, weights = flat[some], u[some], weights[some]
    return u, flat, weights, shape, len(points[0]), size


def _check_weights(weights: Tensor, smoothing: Smoothing, keep: int) -> None:
    """Raise ValueError if few of the weights [S] count, as those of "uniform" do in more than a few dimensions."""
    shares = weights / weights.max()
    effective = float(shares.sum().square() / shares.square().sum())
    if not effective >= min(fewest_samples(keep), _COUNTING * len(weights)):
        raise ValueError(
            f"proposal {smoothing.proposal!r} leaves an effective sample size of {effective:.3g} of {len(weights)} "
            f"samples, (sum of weights)^2 / (sum of squared weights), and {keep} parameters per output (keep) need "
            f"{fewest_samples(keep)}: use proposal 'gaussian', whose weights are all 1"
        )


def _checked(previous: SparseJacobian, n: int, shape: torch.Size) -> SparseJacobian:
    if not isinstance(previous, SparseJacobian):
        raise TypeError(f"previous must be a SparseJacobian, got {type(previous).__name__}")
    if previous.n != n or previous.shape != shape:
        raise ValueError(
            f"previous must be a Jacobian of outputs {list(shape)} of {n} parameters, got one of outputs "
            f"{list(previous.shape)} of {previous.n} parameters"
        )
    return previous
