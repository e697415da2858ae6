"""A layer whose derivatives are a sparse smoothed Jacobian, estimated from its own evaluations."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.autograd.captured import warn_of_captured
from torch_zerohess.autograd.layer import Layer
from torch_zerohess.autograd.marker import Input
from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.estimation.evaluation import evaluate_center
from torch_zerohess.estimation.inputs import checked_input, working
from torch_zerohess.estimation.sparse_jacobian import check_output, estimated
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.precision import without_autocast
from torch_zerohess.smoothing import Smoothing
from torch_zerohess.surrogates.sparse_fit import SparseSettings, check_grid, checked_rate
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian


class SparseBlackBox(Layer):
    """A black box whose outputs depend on few parameters each, as a layer: y = f(x), dy/dx = the smoothed Jacobian.

    `BlackBox` estimates first derivatives without bias and with a noise that grows with n. This layer finds which
    parameters each output depends on, from the evaluations of the call and what earlier calls have found, see
    `sparse_jacobian`. Its derivatives have far less noise where Jacobians are sparse. They are biased by the entries
    that are not found, and useless where the Jacobian is dense. `jacobians[b].explained` should be near 1. Where each
    output depends on one parameter, as behind a rounding, their error is below the error of `BlackBox` from a few
    parameters on. With two parameters, and tens of samples for each, `BlackBox` is the better choice.

    The layer is linear in x around the point of the call. So the second derivatives of a loss behind it are J^T H J,
    the Gauss-Newton matrix, with the Hessian H of the loss in the outputs.

    `backward`, double backward and `torch.autograd.functional` work, and curvature="gauss_newton" of `optim.NewtonCG`.
    Inside of `torch.func` transforms, `torch.compile` and `torch.jit.trace` it raises RuntimeError. `BlackBox` serves
    the first two.

    Each element begins with the latest Jacobian, of the element before it or of the call before. Its samples are
    others, also with a fixed seed: `explained` and `standard_error` need samples that the latest Jacobian has not seen.
    So a call that is repeated has other derivatives. A new layer with the same seed repeats those of the first calls. A
    state_dict does not keep what was found.

    Args:
        fn: [K, n] -> [K, *out], an output of at least two numbers. It gets detached, contiguous tensors.
        smoothing: how to sample around each element of the batch, see `sparse_jacobian`; its evaluations per element
            are 2 * samples, or samples without antithetic pairs, besides f(x).
        keep, rate, grid: see `sparse_jacobian`.
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        on_nonfinite: "raise", "drop", or a number that replaces NaN and infinities; f(x) must be finite for "drop".

    Shapes: x [*batch, n] -> [*batch, *out], of the dtype and on the device of x. If no derivative can be asked for,
    only f(x) is evaluated.

    Example:
        >>> blur = lambda z: torch.nn.functional.avg_pool2d(z.view(-1, 20, 20), 3, 1).round(decimals=1)
        >>> layer = SparseBlackBox(blur, Smoothing(sigma=1.0, samples=100, seed=0), grid=(20, 20))
        >>> x = torch.zeros(400, requires_grad=True)
        >>> layer(x).sum().backward()
        >>> round(float(x.grad.view(20, 20)[5:15, 5:15].mean()), 1), layer.jacobians[0].explained > 0.9
        (1.0, True)
    """

    jacobians: list[SparseJacobian]
    """Of the latest call with derivatives, one per element of the batch."""

    def __init__(
        self,
        fn: Callable[..., Any],
        smoothing: Smoothing,
        *,
        keep: int | None = None,
        rate: float = 0.1,
        grid: Sequence[int] | None = None,
        vectorized: bool = True,
        evaluator: Evaluator | None = None,
        on_nonfinite: str | float = "raise",
    ) -> None:
        super().__init__()
        checked_rate(rate)
        if grid is not None:
            check_grid(grid)
        self.smoothing = smoothing
        self.call = BlackBoxCall(fn, vectorized, evaluator, on_nonfinite=on_nonfinite)
        warn_of_captured(fn)
        self.settings: dict[str, Any] = {"keep": keep, "rate": rate, "grid": grid}
        self.jacobians = []
        self._warned = False

    def forward(self, x: Tensor) -> Tensor:
        """Return values [*batch, *out] for x [*batch, n]; an empty batch needs a call with derivatives before it."""
        if transforms.jit_traces() or transforms.watched(x) or transforms.has_tangent(x):
            raise RuntimeError("a SparseBlackBox has no torch.func transforms and is not compiled: use BlackBox")
        known = self.jacobians[-1] if self.jacobians else None
        x = checked_input(x, empty=known is not None)
        batch, n = x.shape[:-1], x.shape[-1]
        if known is not None and not batch.numel():
            if n != known.n:
                raise ValueError(f"x must have {known.n} parameters like the call before it if it is empty, got {n}")
            return x.sum(-1).view(*batch, *[1] * len(known.shape)).expand(*batch, *known.shape)
        SparseSettings.checked(n, **self.settings)
        center = working(x).detach().reshape(-1, n).clone()
        values = evaluate_center(self.call, center, ()).to(center.dtype)
        check_output(values.shape[1:], "BlackBox")
        if transforms.derivative_possible(x):
            self.jacobians = jacobians = self._jacobians(center, values.shape[1:])
            change = Input.apply(working(x)).reshape(-1, n) - center
            with without_autocast(x.device):
                values = values + torch.stack([J.matvec(d) for J, d in zip(jacobians, change, strict=True)])
        return values.reshape((*batch, *values.shape[1:])).to(x.dtype)

    def _jacobians(self, points: Tensor, shape: Sequence[int]) -> list[SparseJacobian]:
        """Return the Jacobian at every point [B, n] of outputs of a shape; each begins with what was found last."""
        call = replace(self.call, value="smoothed")
        known = self.jacobians[-1] if self.jacobians else None
        if known is not None and (known.n, tuple(known.shape)) != (points.shape[1], tuple(shape)):
            known = None
        found, doubt = list[SparseJacobian](), ""
        for point in points:
            known, doubt = estimated(call, point, self.smoothing, self.settings, known)
            found.append(known)
        if doubt and not self._warned:  # of the last element, which begins with what the others have found
            self._warned = True
            warnings.warn(doubt, UserWarning, stacklevel=2)
        return found
