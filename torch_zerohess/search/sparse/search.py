"""Gauss-Newton for outputs whose elements depend on few parameters each: thousands of parameters, few evaluations.

Such outputs are local. The other modules of the folder name this search after its Jacobian, which is sparse: see
`method` for how it goes on, and `noisy_method` and `averaging` in noise.
"""

from __future__ import annotations  # signatures print names of types, not what they stand for

from collections.abc import Callable
from typing import Any

from torch import Tensor

from torch_zerohess.search.protocol.ask_tell import AskTell
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.space import Bounds, Vector
from torch_zerohess.search.sparse.method import SparseMethod
from torch_zerohess.search.sparse.noisy_method import sparse_method
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.search.sparse.settings import SPARSE_TOLERANCE, SparseSearchSettings
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian


class LocalGaussNewton(AskTell[SparseProgress]):
    """Gauss-Newton for a black box [n] -> [*out] whose outputs depend on few of thousands of parameters each.

    Textures, height fields, vertices and voxels are such parameters, pixels such outputs. Which pixel depends on which
    parameter need not be known: samples of all parameters at once determine it. It evaluates the start and `samples`
    points before its first step, and `samples` and six steps per iteration. It needs no derivative of the black box.
    Where every output depends on every parameter it finds no support and does not move: use `TrustRegion`, which
    notices.

    Where its steps hardly lower the loss, it hops to a random point close by, at 0.3 sigma per parameter, and goes on
    from there. It stays with what it finds if the loss is lower, and returns otherwise.

    In noise, as `noise` says, it begins to average where the best step changes the loss by no more than noise may, or
    where three rounds have arrived at the best point. All evaluations nearby then determine the Jacobian and the output
    at the center, so both become more exact as evaluations are added. It evaluates the center twice and samples around
    it per iteration. From then on it does not hop, and does not end by itself. `value` is then the loss of the output
    of the regression. `averages` says whether the search averages.

    Only parameters that some output was found to depend on are moved. The others stay where they are, and `untouched`
    names them. Of the parameters found in a batch, at most 0.5 % have no effect, by expectation. A parameter with a
    weak effect counts as untouched until there is enough evidence. Samples perturb all parameters. So no sample is the
    best point while some parameters stay. Where the search arrives, it moves only the parameters that stay, once to
    each side. If outputs change there, no parameter stays any more. If the loss falls, too, the search goes on from
    there.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: length over which the output changes, in units of the parameters; one value, or one per parameter [n].
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch. It should be
            convex, as a mean of squares is: directions in which it bends downwards count as straight. It may have
            kinks, as a mean of magnitudes has, and Huber's loss nearly has. Steps there minimise the loss of the
            linear outputs, which calls it some hundred times per step.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        grid: rows and columns (and channels) in which the parameters lie, with n numbers in all. Neighbours then share
            evidence, which helps where outputs depend on patches of parameters. If None, a grid in the proportions of
            the image is tried in the first three fits. It stays if it predicts more of the held-out change.
        keep: parameters per output, at most. If None, 16 at first, and twice as many where most outputs have reached
            that: 64 at most, and never more than there are.
        samples: of an iteration at first, at least 8 and at least keep + 2. An iteration that hardly lowers the loss
            doubles them, once; a good one halves them again.
        rate: of false discoveries among the pairs of output and parameter that are found in a round of a fit, see
            `sparse_jacobian`.
        radius: first length of a step, root mean square over the parameters, in units of sigma. It is at least 1 if
            the first Jacobian predicts 90 % of held-out samples.
        share: distance of the samples, in units of the radius; the first ones have the distance sigma.
        least_sigma: least distance of the samples, in units of sigma.
        restarts: how often to hop after the search has arrived; 0: it does not hop at all. Where the Jacobian predicts
            less than half of the held-out change, it begins again with the first radius instead.
        tolerance: radius, in units of sigma, at which the search has arrived.
        noise: standard deviation of repeated losses at one point, if they differ. The search uses only whether it is
            above 0: repeated outputs show how large the noise is.
        seed: of the samples; from torch's global generator if None.

    Outputs of two dimensions or more are images, whose neighbouring pixels share evidence: see `sparse_jacobian`.

    Raises ValueError for settings out of range, TypeError for settings of another type, and ValueError from the first
    `tell` for outputs of one number.

    Example:
        >>> import torch
        >>> target = torch.rand(20, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> loss = lambda image: (image - target).square().mean()
        >>> search = LocalGaussNewton(torch.zeros(400).double(), sigma=1.0, loss=loss, seed=0)
        >>> while search.evaluations < 39:
        ...     search.tell(search.ask().view(-1, 20, 20))
        >>> search.value < 1e-3  # of 0.3
        True
    """

    def __init__(
        self,
        x0: Vector,
        *,
        sigma: float | Vector,
        loss: Callable[[Tensor], Tensor],
        bounds: Bounds | None = None,
        grid: tuple[int, ...] | None = None,
        keep: int | None = None,
        samples: int = 32,
        rate: float = 0.1,
        radius: float = 0.5,
        share: float = 0.35,
        least_sigma: float = 0.03,
        restarts: int = 10,
        tolerance: float = SPARSE_TOLERANCE,
        noise: float = 0.0,
        seed: int | None = None,
    ) -> None:
        self._own: dict[str, Any] = {"grid": grid, "keep": keep, "samples": samples, "rate": rate}
        self._own |= {"radius": radius, "share": share, "least_sigma": least_sigma}
        settings: dict[str, Any] = {"restarts": restarts, "tolerance": tolerance, "noise": noise, "seed": seed}
        super().__init__(x0, sigma=sigma, bounds=bounds, loss=loss, **settings)

    @property
    def jacobian(self) -> SparseJacobian | None:
        """The latest smoothed Jacobian, in units of the first sigma per parameter; None before the first one."""
        return self._state.progress.jacobian

    def _make(self, settings: Settings) -> SparseMethod:
        return sparse_method(settings, SparseSearchSettings.checked(settings, **self._own))
