"""Targets for the outputs of a network: a Newton step on the loss of every element of a batch, in the outputs alone."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import check_state, check_tensors, checked_integer, checked_number
from torch_zerohess.autograd.graph import check_twice
from torch_zerohess.autograd.tracing import never_compiled
from torch_zerohess.linalg.magnitudes import magnitudes
from torch_zerohess.linalg.saddle_free import saddle_free_steps
from torch_zerohess.optim.elements import check_elements
from torch_zerohess.version import VERSION

_DENSE = 16
"""Outputs up to which the Hessian of every element is formed and solved."""
_TOLERANCE = 1e-2
"""Residual of the system, relative to the gradient."""
_PATIENCE = 100
"""Calls without a new preconditioner, after one with which its own call did not converge."""


class NewtonTargets:
    """Returns, for every element of a batch, the end of a Newton step on its loss (Petersen et al. 2024).

    For losses l of outputs y [B, n] with gradient g and Hessian H of every element,

        t = y - (H + relative_damping * h I)^-1 g,    h = mean of the diagonal of H

    `0.5 * (network(images) - t).square().sum(1)` has the gradient of l where H is the identity. Any first-order
    optimizer of the weights then trains as if the loss were well-conditioned in y. Convergence no longer depends on the
    condition of the black box. For a batch much smaller than the weights this needs no curvature of the network.

    |H|, with the magnitudes of the eigenvalues of H, takes the place of H in t and in h (Dauphin et al. 2014): negative
    curvature makes a step as long as positive curvature does. Up to 16 outputs |H| is formed. For more outputs the
    system is solved in a Krylov space of Hessian-vector products. If H has no negative curvature there, this is the
    method of conjugate gradients. If it has, the step is (|H| + relative_damping * h I)^-1 g where all elements have
    one H, and of about this length where their Hessians differ. Negative curvature that `iterations` do not find can
    make a step longer: `output_radius` is its bound. h is v^T |H| v / n with random signs v (Hutchinson 1989), where
    |H| is taken in the space of v and H v.

    Where H is 0 up to rounding, as for a loss that is linear in y, the step is g. H counts as rounding where
    h <= sqrt(eps) |g| / max |y| and h <= sqrt(eps) |g|^2 / max |l|. The maxima are over the batch, and eps is that of
    the type of y.

    The preconditioner is one matrix: column i is from the Hessian over h of element i modulo B. Later calls keep it.
    Where `iterations` do not reach a residual of 1 %, the call makes another one. If the residual stays above 1 % with
    that one, too, the step is taken as it is, and the next 100 calls make none. An affine black box with a quadratic
    loss takes one iteration.

    Every call checks by two more backward passes, of first and of second order, that no loss depends on the outputs of
    another element.

    In several processes each has the targets of its part of the batch. Let `DistributedDataParallel` follow them by the
    loss above and `backward`; `move_outputs` is of one process.

    `state_dict` has the preconditioner, and not the settings. With it, training that was resumed continues to the bit
    for more than 16 outputs, too.

    Args:
        relative_damping: of the Hessian, in units of h; positive.
        iterations: dimension of the Krylov space at most.
        output_radius: longest step |t - y| of an element, in units of y.

    Example:
        >>> scale = torch.tensor([1.0, 100.0])
        >>> targets = NewtonTargets(relative_damping=1e-9)
        >>> targets(lambda y: (scale * (y - 3.0)).square().sum(1), torch.zeros(1, 2))
        tensor([[3.0000, 3.0000]])

    Source: Petersen, Sutter, Borgelt, Huh, Kuehne, Sun, Deussen: Newton Losses, NeurIPS 2024, equation 2.
    """

    def __init__(
        self, *, relative_damping: float = 1e-3, iterations: int = 16, output_radius: float = math.inf
    ) -> None:
        self.relative_damping = checked_number("relative_damping", relative_damping, above=0.0)
        self.output_radius = checked_number("output_radius", output_radius, above=0.0)
        self.iterations = checked_integer("iterations", iterations, 1)
        self.losses: Tensor | None = None
        """[B], of the last call."""
        self._factor: Tensor | None = None
        self._wait = 0
        """Calls that make no new preconditioner."""

    def __repr__(self) -> str:
        names = ("relative_damping", "iterations", "output_radius")
        return f"NewtonTargets({', '.join(f'{name}={getattr(self, name)}' for name in names)})"

    def state_dict(self) -> dict[str, Any]:
        """Return what a call leaves for later ones: the preconditioner, and how many calls make no new one.

        Tensors and numbers alone, which `torch.load` reads with `weights_only=True`.
        """
        return {"factor": self._factor, "wait": self._wait, "version": VERSION}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take a `state_dict`.

        Raises TypeError for a state that is no dictionary or has something else in it, KeyError for one that lacks a
        part, and ValueError for a preconditioner that is no square matrix.
        """
        check_state(state, self.state_dict(), "NewtonTargets")
        factor, wait = state["factor"], checked_integer("wait", state["wait"], 0)
        if factor is not None:
            check_tensors(factor=factor)
            if factor.ndim != 2 or factor.shape[0] != factor.shape[1]:
                raise ValueError(f"factor must be a matrix [n, n], got {list(factor.shape)}")
            factor = factor.detach().to(torch.float64, copy=True)
        self._factor, self._wait = factor, wait

    @never_compiled
    def __call__(self, losses: Callable[[Tensor], Tensor], y: Tensor) -> Tensor:
        """Return the targets [B, n], without a graph.

        Raises TypeError for y that is no tensor, and RuntimeError in inference mode and for losses that `torch.compile`
        computes. Raises ValueError for y that is not [B, n], for losses that are not [B], have no graph or depend on
        other elements, and for a gradient or curvature that is not finite.

        Args:
            losses: outputs [B, n] -> losses [B], twice differentiable, each of its own element.
            y: outputs [B, n].
        """
        check_tensors(y=y)
        if y.ndim != 2:
            raise ValueError(f"y must be [B, n], got {list(y.shape)}")
        if not y.is_floating_point():
            raise ValueError(f"y must be of floating point, got {y.dtype}")
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                "targets need derivatives of the losses, which inference mode forbids: use torch.no_grad"
            )
        if not y.numel():
            self.losses = y.new_zeros(len(y))
            return y.detach().clone()
        at = y.detach().requires_grad_()
        with torch.enable_grad():
            values = losses(at)
            if values.shape != at.shape[:1]:
                raise ValueError(f"losses(y) must be [{len(at)}], one for each element, got {list(values.shape)}")
            if not values.requires_grad:
                raise ValueError(
                    "losses(y) has no graph back to y: compute it from y by torch, without no_grad or detach"
                )
            check_twice([values], [at])
            (g,) = torch.autograd.grad(values.sum(), at, create_graph=True)
        self.losses = values.detach()
        gradient = g.detach()

        _check(gradient)

        def slopes(c: Tensor) -> Tensor:
            (cg,) = torch.autograd.grad(values, at, c.to(values), retain_graph=True)
            return cg

        check_elements(slopes, gradient)

        def product(v: Tensor) -> Tensor:
            if not g.requires_grad:  # a loss that is linear in y
                return torch.zeros_like(v)
            (hv,) = torch.autograd.grad(g, at, v, retain_graph=True, materialize_grads=True)
            return hv

        solve = self._dense if y.shape[1] <= _DENSE else self._iterate
        step = solve(product, gradient, _least(gradient, y.detach(), self.losses))
        _check(step)
        if self.output_radius < math.inf:
            length = step.double().norm(dim=1, keepdim=True)
            step = step * (self.output_radius / length.clamp_min(self.output_radius)).to(step.dtype)
        return y.detach() - step

    def _dense(self, product: Callable[[Tensor], Tensor], gradient: Tensor, least: Tensor) -> Tensor:
        n = gradient.shape[1]
        units = torch.eye(n, dtype=gradient.dtype, device=gradient.device)
        columns = torch.stack([product(unit.expand_as(gradient)) for unit in units], 2)
        v = torch.rand(
            gradient.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu"
        ).to(gradient)
        check_elements(lambda c: product(c[:, None] * v), torch.einsum("bij,bj->bi", columns, v))
        h = _magnitudes(columns.double())
        size = h.diagonal(dim1=1, dim2=2).abs().mean(1, keepdim=True)
        curved = size > least
        shift = self._shift(curved * size)
        h = curved[:, :, None] * h + shift[:, :, None] * torch.eye(n, dtype=h.dtype, device=h.device)
        return torch.linalg.solve(h, gradient.double()).to(gradient.dtype)

    def _shift(self, size: Tensor) -> Tensor:
        """Return the damping for h; 1 for a Hessian of zeros."""
        return torch.where(size > 0, self.relative_damping * size, 1.0)

    def _iterate(self, every: Callable[[Tensor], Tensor], gradient: Tensor, least: Tensor) -> Tensor:
        n = gradient.shape[1]
        coins = torch.rand(n, generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu")
        signs = torch.where(coins < 0.5, -1.0, 1.0).to(gradient)
        image = every(signs.expand_as(gradient))
        _check(image)
        size = _size(every, signs, image)
        curved = size > least
        size = curved * size

        def product(v: Tensor) -> Tensor:
            return curved * every(v)

        check_elements(lambda c: every(c[:, None] * signs), image)
        if self._factor is not None and self._factor.shape[0] == n:
            self._factor = self._factor.to(gradient.device)  # a loaded one may be elsewhere
            step, converged = self._solve(product, gradient, size)
            if converged or self._wait:
                self._wait = max(self._wait - 1, 0)
                return step
        self._precondition(product, gradient, size)
        step, converged = self._solve(product, gradient, size)
        self._wait = 0 if converged else _PATIENCE
        return step

    def _precondition(self, product: Callable[[Tensor], Tensor], gradient: Tensor, size: Tensor) -> None:
        """Factorise a mixture of the Hessians of the batch over h, [B, 1]: column i is of element i modulo B."""
        n = gradient.shape[1]
        units = torch.eye(n, dtype=gradient.dtype, device=gradient.device)
        columns = []
        for part in units.split(len(gradient)):
            v = torch.zeros_like(gradient)
            v[: len(part)] = part
            columns.append((product(v) / torch.where(size > 0, size, 1.0))[: len(part)])
        h = _magnitudes(torch.cat(columns).double())
        shift = self._shift(h.diagonal().abs().mean())
        self._factor = torch.linalg.cholesky(h + shift * torch.eye(n, dtype=h.dtype, device=h.device))

    def _solve(self, product: Callable[[Tensor], Tensor], gradient: Tensor, size: Tensor) -> tuple[Tensor, bool]:
        """Solve (|H| + relative_damping h I) s = g for all elements. size: h, [B, 1]."""
        assert self._factor is not None

        def image(v: Tensor) -> Tensor:
            hv = product(v.to(gradient.dtype)).double()
            _check(hv)
            return hv

        s, converged = saddle_free_steps(
            image,
            gradient.double(),
            self._shift(size).double(),
            self._factor,
            iterations=self.iterations,
            tolerance=_TOLERANCE,
        )
        return s.to(gradient.dtype), converged


def _least(gradient: Tensor, y: Tensor, losses: Tensor) -> Tensor:
    """Return the h of every element, [B, 1], up to which H is rounding.

    With this h, the step g/h has the length max |y| / sqrt(eps) or more, and |g|^2/h is max |l| / sqrt(eps) or more.
    One of the maxima may be zero: it then decides nothing.
    """
    slope = gradient.double().norm(dim=1, keepdim=True)
    least = torch.minimum(slope / y.double().abs().max(), slope * (slope / losses.double().abs().max()))
    return math.sqrt(torch.finfo(y.dtype).eps) * least.nan_to_num(0.0, posinf=0.0)


def _size(product: Callable[[Tensor], Tensor], signs: Tensor, image: Tensor) -> Tensor:
    """Return v^T |H| v / n of every element, [B, 1], for v = signs [n] and image = H v [B, n].

    |H| is taken in the space of v and H v. If H has no negative curvature there, this is v^T H v / n.
    """
    scale = math.sqrt(len(signs))
    v, hv = signs.double() / scale, image.double() / scale
    first = (hv @ v)[:, None]
    rest = hv - first * v
    beside = rest.norm(dim=1, keepdim=True)
    w = torch.where(beside > 0, rest / beside, 0.0)
    second = (product(w.to(image.dtype)).double() * w).sum(1, keepdim=True)
    h = torch.cat([first, beside, beside, second], 1).view(-1, 2, 2)
    return _magnitudes(h)[:, :1, 0].to(image.dtype)


def _magnitudes(h: Tensor) -> Tensor:
    """Return Hessians [..., n, n], symmetric and with the magnitudes of their eigenvalues."""
    _check(h)
    return magnitudes(0.5 * (h + h.mT))


def _check(x: Tensor) -> None:
    if not bool(torch.isfinite(x).all()):
        raise ValueError("the gradient or the curvature of the losses is not finite")
