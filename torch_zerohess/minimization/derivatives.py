"""Gradient and Hessian at the end of a search, from its own model or from all evaluations."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.linalg.metric import region_step
from torch_zerohess.minimization.regression import FITTED
from torch_zerohess.search.protocol.state import are_same
from torch_zerohess.search.trust_region import TrustRegion
from torch_zerohess.surrogates.noisy_derivatives import noisy_derivatives
from torch_zerohess.surrogates.quadratic import LocalModel
from torch_zerohess.surrogates.quadratic_around import quadratic_around

_RELIABLE, _MORE_RELIABLE = 0.1, 1e-3
"""Largest relative standard error of its Hessian with which it replaces a model of the loss, and one of the output."""
_FLAT, _LEVEL = 1e-6, 1e-3
"""Curvature and slope along a direction, in units of sigma and over the largest curvature, of a loss that hardly
changes along it: at a bound there may be a slope."""


class Derivatives(NamedTuple):
    """A quadratic around the best point, see `Minimum`; its width alone where too few evaluations lie there."""

    gradient: Tensor | None
    hessian: Tensor | None
    standard_errors: dict[str, Tensor] | None
    sigma: Tensor


def quadratic_at(
    x: Tensor,
    search: TrustRegion,
    points: Tensor,
    losses: Tensor,
    noise: float,
    measured: tuple[LocalModel, float] | None = None,
) -> Derivatives:
    """Return the quadratic around x [n] of a search with evaluations [P, n] and [P]; or a measured one."""
    unit, found = search.unit, measured or _model(x, search, points, losses, noise)
    if found is None:
        return Derivatives(None, None, None, unit.to(x))
    model, unit = found[0], unit * found[1]
    gradient = (model.full_gradient() / unit).to(x)
    hessian = (model.full_hessian() / (unit[:, None] * unit)).to(x)
    slope, bend = model.full_errors()
    errors = {"gradient": (slope / unit).to(x), "hessian_diagonal": (bend / unit.square()).to(x)}
    return Derivatives(gradient, hessian, errors, unit.to(x))


def is_flat(found: Derivatives, unit: Tensor) -> bool:
    """Whether the loss hardly changes along some direction, as far as the evaluations determine all curvatures.

    Args:
        found: the quadratic around x.
        unit: sigma of every parameter [n].
    """
    gradient, hessian, errors = found.gradient, found.hessian, found.standard_errors
    if gradient is None or hessian is None or errors is None or not 1 < len(unit) <= FITTED:
        return False
    bent, slope = hessian.to(unit) * unit[:, None] * unit, gradient.to(unit) * unit
    if not bool(torch.isfinite(errors["hessian_diagonal"]).all() and torch.isfinite(bent).all()):
        return False
    curvatures, directions = torch.linalg.eigh(bent)
    largest = float(curvatures[-1])
    return bool(((curvatures.abs() < _FLAT * largest) & ((slope @ directions).abs() <= _LEVEL * largest)).any())


def is_elsewhere(found: Derivatives, x: Tensor, search: TrustRegion) -> bool:
    """Whether the quadratic around x [n] has its minimum within the bounds elsewhere, or is not known.

    Elsewhere is farther away than the tolerance with which the search arrives.
    """
    if found.gradient is None or found.hessian is None:
        return True
    unit, root = search.unit, torch.eye(len(x), dtype=search.unit.dtype, device=search.unit.device)
    slope, bend = found.gradient.to(unit) * unit, found.hessian.to(unit) * unit[:, None] * unit
    if not bool(torch.isfinite(slope).all() and torch.isfinite(bend).all()):
        return True
    lower, upper = ((one - x).to(unit) / unit for one in search.bounds)
    return not are_same(region_step(slope, bend, root, lower, upper), torch.zeros_like(unit), search.tolerance)


def _model(
    x: Tensor, search: TrustRegion, points: Tensor, losses: Tensor, noise: float
) -> tuple[LocalModel, float | Tensor] | None:
    """Return the search's quadratic model around x and its sigma; or that of all evaluations, if it is better.

    It is also better where the model of a loss alone has infinite errors.
    In noise it is better if there are enough of them: its standard errors contain what is not quadratic.
    """
    found, unit = search.model_at_best(x), search.unit
    if len(x) > FITTED:
        return found
    x, points, losses = x.to(unit) / unit, points.to(unit) / unit, losses.to(unit)
    if noise:
        return noisy_derivatives(x, points, losses, noise) or found
    around = quadratic_around(x, points, losses)
    most = _RELIABLE if found is None or found[0].jacobian is None else _MORE_RELIABLE
    if around is None or (found is not None and around[2] > most and _is_determined(found[0], search)):
        return found
    return around[:2]


def _is_determined(model: LocalModel, search: TrustRegion) -> bool:
    """Whether evaluations determine the curvatures of a model. Models of outputs have no errors of them."""
    return search.loss is not None or bool(model.full_errors()[1].isfinite().all())
