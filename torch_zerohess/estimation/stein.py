"""Stein's identities as sums over samples: the interface of a family of weights.

Every estimate is a weighted sum of black-box values f_k. The weight is a kernel of the dimensionless perturbation u_k:

| | likelihood ratio | element-wise (optimal) | signed lobes (FR22) |
|---|---|---|---|
| value | w_k | 1 on the rows of the value | 1 |
| gradient_i | w_k u_i | sign(u_i) sqrt(2/pi) on the rows of i | sign(u_i) sqrt(2/pi) |
| Hessian_ij | w_k (u_i u_j - delta_ij) | constant times sign on the rows of ij | none |

`ratio(d)` generates all kernels of a family. At d = (x - x_0) / sigma = 0 its value is the kernel of the value, its
first derivative the kernel of the gradient, its second derivative the kernel of the Hessian. For a likelihood ratio it
is N(z; x) / p(z) = w exp(u.d - d.d/2), so derivatives of every order are estimators.

To add a family: write one subclass of `Stein` in a file of its own and name it in `perturbations.FAMILIES`.

Shapes: B batch, K samples, M vectors, n parameters, P outputs. Coefficients a are [B, M, K]. Everything is float64 and
in units of sigma, but for `scaled_gradient` and `scaled_hvp`: the caller divides by sigma.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torch_zerohess.estimation.skewness import Shape
from torch_zerohess.sampling.kernels import Samples
from torch_zerohess.smoothing import Smoothing

Quantity = Literal["value", "gradient", "hessian_diagonal", "hessian", "hvp"]
Projection = Callable[[Samples, Tensor], Tensor]
"""(u [B, K, n] or its recipe, t [B, M, n]) -> [B, M, K], differentiable in t: see `autograd.linear_map.project`."""

FIRST_ORDER_ERROR = (
    "these samples serve first derivatives only (proposal 'fr22', or 'optimal' with order=1): "
    "use Smoothing(proposal='aggregate', order=2) for Hessians and Hessian-vector products"
)
ORDER_ERRORS = {
    1: FIRST_ORDER_ERROR,
    2: "proposal 'optimal' has samples for the value, gradient and Hessian, and none for third derivatives: "
    "use Smoothing(proposal='aggregate')",
}
"""What to say of a derivative beyond the order that samples serve."""


class Spread(NamedTuple):
    """How far an estimate may be from its expectation."""

    variance: Tensor
    degrees: Tensor
    """Degrees of freedom of the variance, for Student's t; of its shape."""
    shape: Shape
    """Skewness and kurtosis."""


class Layout(NamedTuple):
    """Shape and dtype of a tensor that is yet to be made."""

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float64
    batched: bool = True
    """Whether the first dimension is the batch; if not, the tensor is the same for every point."""


class Stein(ABC):
    """A family of weights for one batch of samples: the sums, and the rules that go with them.

    A family without second derivatives leaves `hvp`, `hessian_diagonal` and `hessian` as they are here, where they
    raise, and returns 1 from `highest`.
    """

    droppable: bool = True
    """Whether the other rows can take over the weight of rows that are dropped."""

    @classmethod
    @abstractmethod
    def draw(
        cls, x: Tensor, sigma: Tensor, smoothing: Smoothing, seed: int, keep: bool, center: bool = False
    ) -> tuple[Tensor, "Stein"]:
        """Draw samples around x [B, n] and return their points [B, K, n], in the dtype of x, and the family.

        sigma: float64 [n]; keep: store the perturbations instead of drawing them again whenever they are needed;
        center: add x as the last point.
        """

    @classmethod
    @abstractmethod
    def layout(cls, smoothing: Smoothing, B: int, K: int, n: int, keep: bool) -> list[Layout]:
        """Return what `tensors` of a batch will look like."""

    @abstractmethod
    def tensors(self) -> list[Tensor]:
        """Return the tensors that represent this batch, contiguous, for `rebuild`."""

    @classmethod
    @abstractmethod
    def rebuild(cls, tensors: Sequence[Tensor], x: Tensor, sigma: Tensor, smoothing: Smoothing, keep: bool) -> "Stein":
        """Return the family that `tensors` were taken from, drawn around x [B, n] with the same sigma and settings."""

    @property
    def highest(self) -> int | None:
        """Highest order of the derivatives that these samples serve, 1 or 2; None if they serve every order."""
        return None

    @property
    def first_order(self) -> bool:
        """Whether these samples serve first derivatives only."""
        return self.highest == 1

    @abstractmethod
    def value(self, a: Tensor) -> Tensor:
        """Return the sums of the value, [B, M]."""

    @abstractmethod
    def gradient(self, a: Tensor) -> Tensor:
        """Return the sums of the gradient, [B, M, n]."""

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        """Return the sums of the Hessian times v [B, M, n], [B, M, n]."""
        raise ValueError(FIRST_ORDER_ERROR)

    def scaled_gradient(self, a: Tensor, sigma: Tensor) -> Tensor:
        """Return the gradient in units of x, [B, M, n]."""
        return self.gradient(a) / sigma

    def scaled_hvp(self, a: Tensor, v: Tensor, sigma: Tensor) -> Tensor:
        """Return the Hessian times v [B, M, n], both in units of x, [B, M, n]."""
        return self.hvp(a, v / sigma) / sigma

    def hessian_diagonal(self, a: Tensor) -> Tensor:
        """Return the sums of the Hessian's diagonal, [B, M, n]."""
        raise ValueError(FIRST_ORDER_ERROR)

    def hessian(self, a: Tensor) -> Tensor:
        """Return the sums of the Hessian, [B, M, n, n]."""
        raise ValueError(FIRST_ORDER_ERROR)

    @abstractmethod
    def ratio(self, d: Tensor, project: Projection) -> Tensor:
        """Return the generating function at d [B, n], [B, K], made of differentiable operations on d."""

    def smoothed(self, values: Tensor, baseline: Tensor, a: Tensor) -> Tensor:
        """Return the estimate of F(x), [B, P].

        values: f [B, K, P] as the black box returned them; baseline: [B, P]; a: (f - baseline) / K [B, P, K].
        """
        return baseline + self.value(a)

    @abstractmethod
    def variance(
        self,
        quantity: Quantity,
        a: Tensor,
        share: Tensor,
        draws: Sequence[Tensor],
        v: Tensor | None,
        pooled: Tensor | None = None,
    ) -> Spread:
        """Return the variance of a sum in its shape: see `standard_error.Divisible.variance` for the arguments."""

    def sums(self, quantity: Quantity, a: Tensor, v: Tensor | None) -> Tensor:
        """Return the sums of one quantity; v is the vector of "hvp"."""
        if quantity == "hvp" and v is not None:
            return self.hvp(a, v)
        sums = {
            "value": self.value,
            "gradient": self.gradient,
            "hessian_diagonal": self.hessian_diagonal,
            "hessian": self.hessian,
        }
        return sums[quantity](a)


def completed(points: Tensor, x: Tensor, center: bool) -> Tensor:
    """Return points [B, K, n], with x [B, n] as the last one where `center`."""
    return torch.cat([points, x[:, None]], 1) if center else points
