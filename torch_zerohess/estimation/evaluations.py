"""What one call of the black box told: points, values, and the expansion made of them."""

from typing import NamedTuple

from torch import Tensor

from torch_zerohess.estimation.coefficients import baseline_of, share_of
from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.likelihood_ratio import LikelihoodRatio
from torch_zerohess.smoothing import Smoothing


class Evaluations(NamedTuple):
    """One call of the black box: its points and values, and the expansion made of them.

    Shapes: B batch, K perturbations, n parameters.
    """

    x: Tensor
    """[B, n]"""
    K: int
    kept_points: Tensor | None
    """Points [B, E, n], in the dtype of x: the K perturbed ones, and x where it was evaluated. None: made again."""
    all_values: Tensor
    """Values there, [B, E, *out], as the black box returned them; zero where they were dropped."""
    kept: Tensor | None
    """Which rows were not dropped, [B, K]; None: all."""
    remaining: Tensor
    """What is smoothed, [B, E, *out]: the values, less what a control variate explains."""
    mean: Tensor | None
    """What was subtracted from `rest` with baseline "mean", its mean over the rows, [B, 1, P]; None with another."""
    smoothing: Smoothing
    expansion: Expansion

    @property
    def share(self) -> Tensor:
        """Weight of each row in a mean, [B, K, 1]: 1/K; where rows were dropped, zero for them and more for others."""
        return share_of(self.kept, len(self.x), self.K, self.x.device)

    @property
    def values(self) -> Tensor:
        """Values at the perturbed points, [B, K, *out]."""
        return self.all_values[:, : self.K]

    @property
    def center(self) -> Tensor | None:
        """f(x), [B, *out], where it was evaluated."""
        return self.all_values[:, self.K] if self.all_values.shape[1] > self.K else None

    @property
    def rest(self) -> Tensor:
        """The values at the perturbed points that are smoothed, [B, K, P]."""
        return self.remaining[:, : self.K].reshape(len(self.x), self.K, -1)

    @property
    def points(self) -> Tensor:
        """Perturbed points [B, K, n], in the dtype of x: made again where they are not kept."""
        if self.kept_points is not None:
            return self.kept_points[:, : self.K]
        stein = self.expansion.stein
        assert isinstance(stein, LikelihoodRatio)
        return stein.points(self.x, self.expansion.sigma, center=False)

    @property
    def baseline(self) -> Tensor:
        """What was subtracted from `rest`, its mean over the rows, [B, 1, P]."""
        return baseline_of(self.remaining, self.mean, self.smoothing)

    @property
    def smoothed(self) -> Tensor:
        """The smoothed `rest` at x, float64 [B, *out], whether or not it is the base of the expansion.

        Without a control variate this is the estimate of F(x).
        """
        expansion = self.expansion
        a = expansion.coefficients.mT
        return expansion.stein.smoothed(self.rest, self.baseline[:, 0], a).reshape(expansion.base.shape)

    @property
    def dropped(self) -> int:
        """Evaluations left out because they, or the other one of their pair, were not finite."""
        return 0 if self.kept is None else int((~self.kept).sum())
