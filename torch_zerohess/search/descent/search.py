"""Second-order descent: which method it is, and its public class."""

from typing import Any

from torch_zerohess.search.descent import metric, noisy
from torch_zerohess.search.descent.noisy import NoisyQuadratics
from torch_zerohess.search.descent.of_loss import LossQuadratics
from torch_zerohess.search.descent.of_output import OutputDescent
from torch_zerohess.search.descent.smoothed import SmoothedQuadratics
from torch_zerohess.search.protocol.ask_tell import AskTell
from torch_zerohess.search.protocol.method import Method, Settings


class Descent(AskTell[Any]):
    """Second-order descent on a smoothed black box, for any number of parameters, with or without bounds.

    Each iteration fits a model to the evaluations made so far, minimises it within a region around x and within the
    bounds, and asks for that one point. The model follows from what is given:

    | given        | parameters    | model                             | arrived: sigma below | evaluations kept     |
    |--------------|---------------|-----------------------------------|----------------------|----------------------|
    | loss         | up to 200     | quadratic of least change         | 1e-6 tolerance       | 3 fits, at least 200 |
    | loss         | more than 200 | smoothed loss                     | never                | 6 n                  |
    | loss, noise  | up to 40      | regression                        | 1e-3 tolerance       | 2 fits               |
    | loss, noise  | more than 40  | smoothed loss                     | tolerance            | max(500, 6 n)        |
    | output       | 1 or 2        | Gauss-Newton, then smoothed loss  | tolerance            | 60                   |
    | output       | 3 and more    | smoothed output, and Gauss-Newton | tolerance            | max(60, 6 n)         |

    - The quadratic of least change goes through the nearest evaluations. Region and samples follow the metric of its
      Hessian: narrow valleys are as wide as long there. On a plateau the smoothed loss is modelled, and sigma grows.
    - The regression is a quadratic through all evaluations near by, with standard errors. No single value decides: x is
      the center of the region, and `value` is what the quadratic says there. The search has also arrived where three
      steps in a row are within their errors and the quadratic takes no more evaluations.
    - With the smoothed loss, decreases below twice the `noise` do not count. New samples around x are asked for where
      the model has predicted badly. With more than 200 parameters there is no test of whether x is a
      minimum.
    - With an output [K, *out] and a white-box `loss`, every evaluation is many equations. The search follows the
      minimum of loss(E f), the loss of the smoothed output, while sigma goes to zero, also where the loss itself rises
      for a while. It uses only whether there is `noise`, not how much.
    - Gauss-Newton by interpolation, in a trust region, goes on where a step was predicted well, until its steps fail.
      With one or two parameters it begins. It takes up to 40 parameters, and no noise. In noise the search follows the
      smoothed output with any number of parameters.

    "3 fits" are three times as many evaluations as a fit takes. After an arrival, possibly at a local minimum, the
    search starts again, up to `restarts` times: from a random point, or in turn from a random point and around the best
    one with more samples per iteration.

    The quadratic of least change may also be of the square or the logarithm of a loss alone, where that quadratic has
    predicted the latest losses better. The square of the root of a mean square is a quadratic. A loss that grows
    steeply is closer to a quadratic on a log scale.

    Where a loss alone is not finite, a plane between evaluations with and without a value bounds the step, so that the
    search follows the border of the region that fails. Up to 100 steps in a row may fail there.

    Beside a kink of a loss alone, with up to 10 parameters, the model is the larger of two quadratics where it has
    predicted the latest losses better than one quadratic. Slopes at up to 6 (n + 1) points around a kink show whether
    it is a minimum: up to 6 (n + 1)(n + 8) evaluations, if no bound is near. If they do not show it, the search has not
    arrived.

    Where a loss alone is flat along some direction at the end of a round, as at the inflection of x^3, two points along
    it are evaluated, a tenth of sigma to both sides. The search goes on from there if one of them is lower.

    After a round two evaluations show whether a loss alone is a sum of functions of one parameter each (in a box, for
    2 to 200 parameters). If such a sum has several minima, its lowest one is sought along all axes at once, and the
    next round begins there: some 40 n evaluations, and 7 if it is convex.

    It has the settings of `AskTell`.

    Source: Powell (2004) for the quadratic of least change; Box and Cox (1964) for squares and logarithms; Wang,
    Fischer and Ritschel (2025) for the smoothed second order; Cartis et al. (2019) and Wild (2017) for Gauss-Newton by
    interpolation; Magnani and Boyd (2009) for the two sides of a kink; Burke, Lewis and Overton (2005) for slopes
    around it; Langerman, Seront and Bersini (1994) for the axes.

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


def descent_method(settings: Settings) -> SmoothedQuadratics | LossQuadratics | NoisyQuadratics | OutputDescent:
    """Return the method for an output, for a loss alone, or for a loss with noise or of many parameters."""
    if settings.loss is not None:
        return OutputDescent(settings)
    if settings.noise:
        return NoisyQuadratics(settings) if settings.n <= noisy.MOST else SmoothedQuadratics(settings)
    if settings.n <= metric.MOST:
        return LossQuadratics(settings)
    return SmoothedQuadratics(settings, arrives=False)
