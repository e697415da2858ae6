"""The Laplace approximation of a posterior: the inverse of a Hessian, where its errors leave it positive definite."""

import torch
from torch import Tensor

_REMEDY = (
    "x may be no minimum, or the data do not determine this parameter beside the others; fix it, or give further data "
    "or a prior"
)


def covariance(hessian: Tensor, errors: Tensor) -> Tensor:
    """Return C = H^-1 [n, n] for H [n, n], whose diagonal has standard errors [n].

    An error d of H_ii changes C_ii by the share d C_ii, to first order. Where this is 1 or more, H - d need not be
    positive definite. Raises ValueError then, and names the parameter, as for H that is not positive definite.
    """
    if not bool(torch.isfinite(hessian).all()):
        raise ValueError("the Hessian must be finite: covariance needs a minimum with finite derivatives")
    H = hessian.double()
    H = 0.5 * (H + H.mT)
    size = H.diagonal().abs().sqrt()
    size = torch.where(size > 0.0, size, 1.0)
    factor, failed = torch.linalg.cholesky_ex(H / (size[:, None] * size))  # units of the parameters may differ
    if int(failed):
        values, vectors = torch.linalg.eigh(H / (size[:, None] * size))
        i, least = int(vectors[:, 0].abs().argmax()), float(values[0])
        raise ValueError(
            "the Hessian must be positive definite for a covariance, but over its diagonal it has the eigenvalue "
            f"{least:.2g}, mostly along parameter {i}: {_REMEDY}"
        )
    C = torch.cholesky_inverse(factor) / (size[:, None] * size)
    shares = errors.double() * C.diagonal()
    if not float(shares.max()) < 1.0:
        i = int(shares.argmax())
        raise ValueError(
            "the Hessian must be positive definite within its errors for a covariance, but the variance of parameter "
            f"{i}, {float(C[i, i]):.3g}, may be wrong by {float(shares[i]):.2g} of itself: {_REMEDY}"
        )
    return C.to(hessian)
