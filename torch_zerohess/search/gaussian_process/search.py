"""Search in a box by a Gaussian process: Bayesian optimization of a composite function, for a few parameters."""

from typing import Any

from torch_zerohess.search.gaussian_process.of_loss import LossProcess
from torch_zerohess.search.gaussian_process.of_output import OutputProcess
from torch_zerohess.search.protocol.ask_tell import AskTell
from torch_zerohess.search.protocol.method import Method, Settings


class GaussianProcessSearch(AskTell[Any]):
    """Search in a finite box by a Gaussian process, for few parameters. It escapes plateaus and local minima.

    - With an output [K, *out] and a white-box `loss`, the process predicts the output anywhere in the box from all
      evaluations. The next point is the one where the loss of the prediction, with some optimism, is lowest; or where
      the process knows least, if that point is known already. Gauss-Newton finishes in a basin, where its first step
      promises to take away a tenth of the loss, or more than an evaluation of the process gains; before the search ends
      it begins for less. It begins right after the first samples where it promises three tenths. Once it has arrived,
      it begins at random points of the box, too, twice for each turn of the process.
    - With the loss alone, the process predicts the loss, or without noise its square or logarithm where that is
      likelier. Quadratics (`Descent`) finish in each basin it finds.
      Where the process finds nothing better, quadratics begin at a random point of the box. While arrivals disagree,
      quadratics begin beside the best point every other time. Where the loss is a sum of functions of one parameter
      each, with several minima, its axes are searched instead, as by `Descent`.

    One evaluation follows another, unless `ask` gets a batch. The search has arrived when three steps in a row are
    shorter than `tolerance`, or when Gauss-Newton or quadratics have ended; these go on to a millionth of the
    tolerance. After each of up to `restarts` arrivals its next steps are more optimistic. With the loss alone they go
    to points that it knows least. With an output they go there only if 4 (n + 1) evaluations have lowered the loss by
    less than a tenth.

    In noise `x` is the point whose predicted output has the lowest loss, or with the loss alone the lowest predicted
    loss, and `value` is that prediction. Noise in outputs is detected after some 10 (n + 1) of them; noise in a plain
    loss is declared with `noise`. Such a loss is predicted on a log scale above some 30 or 300 deviations of the noise,
    or as it is, whichever is likelier: in a wide box it may span many decades. One step in four takes it as it is.

    It has the settings of `AskTell`; `bounds` are required and finite. By default the pool keeps 60 evaluations. The
    time of a step grows with the third power of their number.

    The process covers a box of about four parameters. With four parameters or more and an output, its kernel is
    additive where the evidence says so. It then covers up to about fifteen parameters, if each number of the output is
    a sum of functions of one or two parameters, as a pixel of an image of several objects nearly is.

    Raises ValueError for settings out of range, or if a bound is missing or infinite; TypeError for settings of another
    type.

    Source: Rasmussen and Williams (2006) for the process; Astudillo and Frazier (2019) for the composite function;
    Duvenaud, Nickisch and Rasmussen (2011) for additive kernels; Snelson, Rasmussen and Ghahramani (2004) for the
    choice of a scale.

    Example:
        >>> import torch
        >>> target = torch.tensor([0.3, 0.7]).sin()
        >>> search = GaussianProcessSearch(
        ...     torch.zeros(2), sigma=0.5, bounds=(-1.0, 1.0), loss=lambda y: (y - target).square().sum(), seed=0
        ... )
        >>> while search.evaluations < 10:
        ...     search.tell(search.ask().sin())
        >>> search.value < 1e-3  # of 0.5
        True
    """

    def _make(self, settings: Settings) -> Method[Any]:
        return process_method(settings)


def process_method(settings: Settings) -> OutputProcess | LossProcess:
    """Return the process of the output if there is a loss, otherwise of the loss. ValueError without a finite box."""
    if not settings.bounded:
        widths = settings.upper - settings.lower
        far = (
            f"bounds {float(widths.max()):g} sigma apart"
            if bool(widths.isfinite().all())
            else "none or an infinite one"
        )
        raise ValueError(
            f"bounds must be finite for a Gaussian process, which predicts all over a box, got {far} for parameter "
            f"{int(widths.argmax())}; Descent needs no bounds"
        )
    return LossProcess(settings) if settings.loss is None else OutputProcess(settings)
