"""Second-order descent: which method it is, and its public class."""

from typing import Any

from torch_zerohess.search import metric_descent, noisy_descent
from torch_zerohess.search.additive_descent import AdditiveQuadratics
from torch_zerohess.search.descent import LocalQuadratics
from torch_zerohess.search.method import Method, Settings
from torch_zerohess.search.noisy_descent import NoisyQuadratics
from torch_zerohess.search.output_descent import OutputDescent
from torch_zerohess.search.protocol import AskTell


class Descent(AskTell[Any]):
    """Second-order descent on a smoothed black box, for any number of parameters, with or without bounds.

    Each iteration fits a quadratic model to the evaluations made so far, minimises it within a region around x and
    within the bounds, and asks for that one point.

    - With the loss alone (up to 200 parameters, no noise), the quadratic is the one of least change through the nearest
      evaluations, and region and samples follow the metric of its Hessian: narrow valleys are as wide as long there.
    - With the loss alone and `noise` (up to 40 parameters), the quadratic is a regression through all evaluations near
      by, with standard errors. No single value decides: x is the center of the region, and the value what the quadratic
      says there.
    - With an output [K, *out] and a white-box `loss`, every evaluation is many equations: it follows the minimum of
      loss(E f), the loss of the smoothed output, while sigma goes to zero, also where the loss itself rises for a
      while. Where a step was predicted well (up to 40 parameters, no noise), Gauss-Newton by interpolation goes on in a
      trust region, until its steps fail.
      With one or two parameters Gauss-Newton comes first, and after it the loss alone is modelled.
    - The smoothed loss is modelled in three cases: on a plateau of a loss alone, with the loss alone and more than 200
      parameters (in noise 40), and with an output in noise of one or two parameters. On a plateau sigma grows. New
      samples around x are asked for where the model has predicted badly.

    Where a loss alone is not finite, a plane between evaluations with and without a value bounds the step, so that the
    search follows the border of the region that fails. Up to 100 steps in a row may fail there.

    At a kink of a loss alone, slopes at up to 4 (n + 1) points around it tell whether it is a minimum: up to
    (n + 1)(4 n + 7) evaluations, if no bound is near. If they do not tell, the search has not arrived.

    After a round two evaluations tell whether a loss alone is a sum of functions of one parameter each (in a box, for
    2 to 200 parameters). If such a sum has several minima, its lowest one is sought along all axes at once, and the
    next round begins there: some 40 n evaluations, and 7 if it is convex.

    Where sigma is below `tolerance` (with the loss alone a millionth of it, in noise a thousandth) the search has
    arrived at a minimum, possibly a local one. With the loss alone and more than 200 parameters nothing tells whether x
    is a minimum, and the search never counts as arrived. In noise it has also arrived where three steps in a row are
    within their errors and the quadratic takes no more evaluations. The search then starts again, up to `restarts`
    times: from a random point, or in turn from a random point and around the best one with more samples per iteration.

    It has the settings of `AskTell`. With an output of one or two parameters, and with the loss alone and more than 40
    parameters, decreases below twice the `noise` do not count. With an output of more parameters `noise` only says
    whether there is noise. By default the pool keeps max(60, 6 n) evaluations of an output. Of a loss alone it
    keeps three times as many as the quadratic is fitted to, and at least 200; in noise twice as many; with more than
    200 parameters (in noise 40) max(500, 6 n).

    Source: Powell (2004) for the quadratic of least change; Wang, Fischer and Ritschel (2025) for the smoothed second
    order; Cartis et al. (2019) and Wild (2017) for Gauss-Newton by interpolation; Burke, Lewis and Overton (2005) for
    slopes around a kink; Langerman, Seront and Bersini (1994) for the axes.

    Example:
        >>> import torch
        >>> search = Descent(torch.tensor([900.0, 850.0]), sigma=500.0, seed=0, restarts=0)
        >>> while search.evaluations < 9:
        ...     z = search.ask()
        ...     search.tell(5 * z[:, 0] ** 2 + 5 * z[:, 1] ** 2 + 7.5 * z[:, 0] * z[:, 1])
        >>> search.value < 1.0  # of 1.3e7
        True
    """

    def _make(self, settings: Settings) -> Method[Any]:
        return descent_method(settings)


def descent_method(settings: Settings) -> LocalQuadratics | AdditiveQuadratics | NoisyQuadratics | OutputDescent:
    """Return the method for an output, for a loss alone, or for a loss with noise or of many parameters."""
    if settings.loss is not None:
        return OutputDescent(settings)
    if settings.noise:
        return NoisyQuadratics(settings) if settings.n <= noisy_descent.MOST else LocalQuadratics(settings)
    if settings.n <= metric_descent.MOST:
        return AdditiveQuadratics(settings)
    return LocalQuadratics(settings, arrives=False)
