"""The Laplace approximation of a posterior: the inverse of a Hessian, where its errors leave it positive definite."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer

_REMEDY = (
    "x may be no minimum, or the data do not determine this parameter beside the others, or the Hessian is not known "
    "well enough; hold it at its value by fixed=[{}], give further data or a prior, or search again from x with loss=, "
    "bounds, restarts=0 and a smaller sigma"
)


def covariance(hessian: Tensor, errors: Tensor, fixed: Sequence[int] = ()) -> Tensor:
    """Return C [n, n], the inverse of H [n, n] without the rows and columns of fixed parameters, which are 0 in C.

    errors: standard errors of the diagonal of H [n].

    An error d of H_ii changes C_ii by the share d C_ii, to first order. Where this is 1 or more, H - d need not be
    positive definite. Raises ValueError then, and names the parameter, as for H that is not positive definite.
    """
    free = _free(fixed, len(hessian)).to(hessian.device)
    C = torch.zeros_like(hessian)
    C[free[:, None], free] = _inverse(hessian[free][:, free], errors[free], free.tolist())
    return C


def _free(fixed: Sequence[int], n: int) -> Tensor:
    """Return the parameters that are not fixed. ValueError for another index or none left, TypeError for no list."""
    if isinstance(fixed, str) or not hasattr(fixed, "__iter__"):
        raise TypeError(f"fixed must be a list of numbers of parameters, as [0], got {fixed!r}")
    numbers = [checked_integer("fixed", one) for one in fixed]
    if wrong := [one for one in numbers if not -n <= one < n]:
        raise ValueError(f"fixed must be numbers of the {n} parameters, from {-n} to {n - 1}, got {wrong[0]}")
    held = {one % n for one in numbers}
    if len(held) == n:
        raise ValueError(f"fixed must leave a parameter whose covariance is sought, got all {n}")
    return torch.tensor([k for k in range(n) if k not in held], device="cpu")


def _inverse(hessian: Tensor, errors: Tensor, names: list[int]) -> Tensor:
    """Return the inverse of the Hessian of the parameters with these numbers."""
    if not bool(torch.isfinite(hessian).all()):
        raise ValueError("the Hessian must be finite: covariance needs a minimum with finite derivatives")
    H = hessian.double()
    H = 0.5 * (H + H.mT)
    size = H.diagonal().abs().sqrt()
    size = torch.where(size > 0.0, size, 1.0)
    factor, failed = torch.linalg.cholesky_ex(H / (size[:, None] * size))  # units of the parameters may differ
    if int(failed):
        values, vectors = torch.linalg.eigh(H / (size[:, None] * size))
        i, least = names[int(vectors[:, 0].abs().argmax())], float(values[0])
        raise ValueError(
            "the Hessian must be positive definite for a covariance, but over its diagonal it has the eigenvalue "
            f"{least:.2g}, mostly along parameter {i}: {_REMEDY.format(i)}"
        )
    if not bool(torch.isfinite(errors).all()):
        i = names[int(errors.isinf().int().argmax())]
        raise ValueError(
            "the error of the Hessian must be known for a covariance, but too few evaluations near x vary parameter "
            f"{i}: search again from x with restarts=0 and a smaller sigma, or hold it at its value by fixed=[{i}] or, "
            "if the data do not determine it, from the start of the search"
        )
    C = torch.cholesky_inverse(factor) / (size[:, None] * size)
    shares = errors.double() * C.diagonal()
    if not float(shares.max()) < 1.0:
        k = int(shares.argmax())
        raise ValueError(
            "the Hessian must be positive definite within its errors for a covariance, but the variance of parameter "
            f"{names[k]}, {float(C[k, k]):.3g}, may be wrong by {float(shares[k]):.2g} of itself: "
            f"{_REMEDY.format(names[k])}"
        )
    return C.to(hessian)
