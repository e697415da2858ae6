"""BOX10: five soft squares that overlap must spread to five places, without two of them taking the same one.

Parameters: x and y of every square, in units of the image side; half width 0.1, bounds 0.1 and 0.9 as in BOX2.
Targets (.21, .21), (.5, .5), (.79, .79), (.21, .79), (.79, .21); starts (.41, .41), (.5, .5), (.59, .59), (.41, .59),
(.59, .41), each coordinate uniform within +-0.025. The image is the clamped sum of the squares. The squares are
interchangeable: the parameter error is the least over all assignments of squares to places. Loss: mean squared
difference of the images; it has many local minima. Sigma: a sixth of the side.

One channel is enough, as the squares are grey. The `fast` preset has 64x64 pixels, the `paper` preset the source's
500x500.
"""

from experiments.problems.soft_squares import box10
from experiments.problems.task import Preset, Task, assigned_error
from experiments.problems.tasks.box2 import fitting


def task(preset: Preset = "fast") -> Task:
    box = box10({"fast": 64, "paper": 500}[preset])
    places = box.loss.target.view(-1, 2)

    return fitting(
        box,
        title="the places of five interchangeable soft squares that overlap at the start",
        parameters="x, y of five centres in units of the image side, 0.1 to 0.9; "
        "starts (.41, .41) (.5, .5) (.59, .59) (.41, .59) (.59, .41) +- .025, "
        "solution (.21, .21) (.5, .5) (.79, .79) (.21, .79) (.79, .21)",
        evaluations=150_000,
        parameter_error=lambda x: assigned_error(x, places),
    )
