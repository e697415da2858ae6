"""The study of batches, run small: rounds, evaluations and ratios are those of the searches."""

import pytest
from small import TASK

from experiments.reports.tables import table
from experiments.studies.batches import HEADERS, Search, _rows, batches


@pytest.mark.usefixtures("quick_workers")
def test_larger_batches_take_fewer_rounds_and_workers_change_nothing(capsys):
    alone, four, spread = batches(("box2",), sizes=(1, 4), workers=1, runs=2, seed=1000)
    assert [(row.task, row.batch, row.workers, row.runs) for row in (alone, four, spread)] == [
        ("box2", 1, 0, 2),
        ("box2", 4, 0, 2),
        ("box2", 4, 1, 2),
    ]
    assert alone.reached == four.reached == spread.reached == 1.0
    assert (alone.rounds_ratio, alone.seconds_ratio) == (1.0, 1.0)
    assert four.rounds < 0.6 * alone.rounds
    assert alone.rounds == alone.evaluations  # one worker evaluates one point in a round
    assert four.rounds >= four.evaluations / 4
    assert four.evaluations > alone.evaluations
    assert (spread.rounds, spread.evaluations, spread.rounds_ratio) == (
        four.rounds,
        four.evaluations,
        four.rounds_ratio,
    )
    assert min(row.seconds for row in (alone, four, spread)) > 0
    assert capsys.readouterr().out.splitlines()[0].split() == table(HEADERS, []).splitlines()[0].split()


def test_a_row_has_medians_over_starts():
    found = [
        [Search(True, 10, 12, 1.0), Search(True, 4, 16, 0.5)],
        [Search(True, 20, 22, 2.0), Search(False, 10, 40, 1.6)],
        [Search(True, 12, 14, 1.0), Search(True, 3, 12, 0.9)],
    ]
    first, second = _rows("t", ((1, 0), (4, 2)), found)
    assert (first.reached, first.rounds, first.evaluations, first.seconds) == (1.0, 12, 14, 1.0)
    assert (second.batch, second.workers, second.runs) == (4, 2, 3)
    assert second.reached == pytest.approx(2 / 3)
    assert (second.rounds, second.evaluations, second.seconds) == (4, 16, 0.9)
    assert second.rounds_ratio == 0.4  # of .4, .5 and .25
    assert second.seconds_ratio == 0.8  # of .5, .8 and .9


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sizes": (4, 1)}, "sizes must begin with 1"),
        ({"runs": 0}, "got .* 0 and"),
        ({"tasks": ("nonpsd",)}, "got nonpsd: its black box returns the loss only"),
        ({"tasks": ("meshfit",)}, "got meshfit: searches within finite bounds"),
        ({"tasks": ("texture",)}, "got texture: a Gaussian process for up to 10 parameters"),
        ({"tasks": (TASK.name,)}, "tasks must be some of"),
    ],
)
def test_bad_input_is_named(given, message):
    given = {"tasks": ("box2",)} | given
    with pytest.raises(SystemExit, match=message):
        batches(given.pop("tasks"), **given)
