"""What the study of losses measures: errors of gradients, and evaluations of searches."""

from dataclasses import dataclass

from experiments.studies.loss_sweeps import Bias


@dataclass(frozen=True)
class GradientError:
    """Relative RMSE of the estimated gradient of an objective."""

    task: str
    loss: str
    form: str
    where: str
    evaluations: int
    rmse: float
    truth_error: float
    """Relative standard error of what it is compared with."""


@dataclass(frozen=True)
class Fit:
    """The trust region from all starts, until an error is reduced by 99 %."""

    task: str
    loss: str
    form: str
    metric: str
    """image: mean squared error of the picture, whatever the loss; parameter: mean squared error of x."""
    evaluations: float | None
    """Median over the runs that get there, if they are at least half of all."""
    evaluations_low: float | None
    evaluations_high: float | None
    """Quartiles over the same."""
    share: float
    seconds: float | None
    runs: int


@dataclass(frozen=True)
class Reached:
    """When a run of the trust region has reduced an error by 99 %; None if it never has."""

    metric: str
    evaluations: int | None
    seconds: float | None


@dataclass(frozen=True)
class LossReport:
    """Everything that `losses` measured."""

    biases: list[Bias]
    errors: list[GradientError]
    fits: list[Fit]
