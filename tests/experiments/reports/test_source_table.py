"""Table 2 of the source: its numbers as they are printed, and beside ratios that are computed by hand."""

import math

import pandas as pd
import pytest

from experiments.reports import result_files, source_table
from experiments.reports.document_tables import Query, table_of
from experiments.reports.summary import Row, Summary, as_table_2


def fits(*rows) -> pd.DataFrame:
    columns = ["task", "method", "metric", "level", "seconds", "evaluations"]
    return pd.DataFrame(rows, columns=columns)


def test_the_numbers_are_those_of_the_source() -> None:
    """Two means over them: of all, and the mean that the paper's headline has (see `speed_ups`)."""
    there = source_table.printed()
    others = there[there["method"] != "OurHVPA"].dropna()
    assert others["printed"].mean() == pytest.approx(2.99, abs=0.005)
    headline = others[~others["method"].isin(["OurH", "OurHVP"]) & (others["task"] != "quad")]
    assert len(headline) == 125
    assert headline["printed"].mean() == pytest.approx(2.71, abs=0.005)
    assert list(there["task"].unique()) == ["quad", "box2", "box10", "mug", "shad", "bunny", "texture", "cnn", "cnn5"]
    assert set(there["level"]) == {90.0, 99.0, 99.9}
    cell = there[(there["task"] == "cnn5") & (there["method"] == "OurG") & (there["metric"] == "image")]
    assert cell.sort_values("level")["printed"].fillna(-1).tolist() == [18.68, -1, -1]


def test_ratios_stand_side_by_side() -> None:
    found = source_table.side_by_side(
        fits(
            ("mug", "our_hvpa", "image", 90.0, 2.0, 10.0),
            ("mug", "our_g", "image", 90.0, 1.0, 30.0),
            ("mug", "cma_es_bounded", "image", 90.0, 8.0, 5.0),
            ("mug", "our_hvpa", "image", 99.0, math.nan, math.nan),
            ("mug", "our_g", "image", 99.0, 1.0, 30.0),
            ("mug", "our_hvpa", "image", 99.9, 2.0, 10.0),
            ("mug", "cma_es_bounded", "image", 99.9, 1.0, 5.0),
        ),
        ["mug"],
    )
    at = found.set_index(["method", "metric", "level"])
    ours, theirs = at.loc["OurG", "image", 90.0], at.loc["CMA-ES", "image", 90.0]
    assert (ours["printed"], ours["seconds"], ours["evaluations"], ours["differs"]) == (3.99, 0.5, 3.0, True)
    assert (theirs["ours"], theirs["seconds"], theirs["evaluations"]) == ("cma_es_bounded", 4.0, 0.5)
    assert not theirs["differs"]  # both are slower than OurHVPA
    assert math.isnan(at.loc["OurG", "image", 99.0]["seconds"])  # nothing to divide by
    lines = {line[1]: line for line in source_table.rows(found, "image")}
    assert lines["`our_g`"] == ["MUG", "`our_g`", "3.99", "0.50", "3.00", "3.91", "-", "-", "3.74", "-", "-", "no"]
    assert lines["`cma_es_bounded`"][-1] == "at 90 % only"
    assert lines["OurH, not measured"][-1] == "-"
    assert lines["OurH, not measured"][2:5] == ["1.57", "-", "-"]
    assert "OurHVPA" not in "".join(lines)


def test_table_of_a_folder() -> None:
    rows = [
        Row("mug", "our_hvpa", "image", 0.9, 2.0, 10.0, 1.0, 3),
        Row("mug", "fr22", "image", 0.9, 3.0, 40.0, 1.0, 3),
    ]
    printed = as_table_2(Summary(None, rows, [], None, [], [], 0))
    line = next(line for line in printed.splitlines() if "`fr22`" in line)
    assert line.split()[:5] == ["MUG", "`fr22`", "5.92", "1.50", "4.00"]
    other = [Row("throw", "our_g", "image", 0.9, 1.0, 1.0, 1.0, 1)]
    with pytest.raises(SystemExit, match="Table 2 of the source has quad, box2"):
        as_table_2(Summary(None, other, [], None, [], [], 0))


def test_table_of_a_document() -> None:
    text = table_of("table_2", Query.of(["of=fitting", "tasks=mug,cnn5", "metric=parameter"]))
    assert "| MUG | `our_g` | 2.36 |" in text
    assert "| CNN5 | OurG, not measured | 3.70 | - | - | - |" in text
    assert "the parameter error is reduced" in text
    with pytest.raises(SystemExit, match="table_2 must have of=NAME"):
        table_of("table_2", Query.of([]))
    with pytest.raises(SystemExit, match=r"tasks must be some of quad, .* got throw"):
        table_of("table_2", Query.of(["of=fitting", "tasks=throw"]))
    assert result_files.read(source_table.NAME)["source"].str.contains("Table 2").all()
