"""Plain text tables: how a value is written, how columns are aligned, and what is printed when."""

import io
import math
import sys

import numpy as np
import pytest
from tqdm import tqdm

from experiments.reports.tables import Printer, cell_text, table


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.12345, "0.123"),
        (-0.12345, "-0.123"),
        (0.00012345, "0.000123"),
        (0.000012345, "1.23e-05"),
        (12.0, "12"),
        (999.4, "999"),
        (999.7, "1000"),
        (1234.5, "1234"),
        (-1234.6, "-1235"),
        (999999.4, "999999"),
        (1e6, "1e+06"),
        (1234567.0, "1.23e+06"),
        (-2.5e8, "-2.5e+08"),
        (math.inf, "inf"),
        (math.nan, "nan"),
        (np.float64(1234.5), "1234"),
    ],
)
def test_numbers_have_three_digits_and_exponents_from_a_million_on(value, text):
    assert cell_text(value) == text


def test_what_is_no_fraction_is_written_as_it_is():
    """Counts are exact, however large."""
    assert [cell_text(value) for value in (1234567, True, "1.23456", "", None)] == [
        *("1234567", "True", "1.23456", "", "-"),
    ]


def test_numbers_are_aligned_to_the_right_and_text_to_the_left():
    text = table(["case", "n"], [["a", 1.23456], ["bb", None], ["c", 12345.6], ["d", 1234567.0]])
    assert text.splitlines() == [
        "case         n",
        "----  --------",
        "a         1.23",
        "bb           -",
        "c        12346",
        "d     1.23e+06",
    ]


def test_a_column_with_a_text_is_aligned_to_the_left_and_lines_end_without_spaces():
    """A dash for a missing value is no text."""
    text = table(["missing", "mixed", "last"], [[None, 1.0, "long enough"], [None, "none", ""]])
    assert text.splitlines() == [
        "missing  mixed  last",
        "-------  -----  -----------",
        "      -  1      long enough",
        "      -  none",
    ]


def test_a_table_without_rows_has_its_headers():
    assert table(["case", "seconds"], []).splitlines() == ["case  seconds", "----  -------"]


def test_rows_have_a_cell_for_every_header():
    with pytest.raises(ValueError, match="shorter"):
        table(["case", "seconds"], [["a"]])


def test_a_printer_prints_each_row_when_it_comes_and_the_headers_with_the_first(capsys):
    printer = Printer("what is below", ["case", "seconds"], [6, 0])
    assert capsys.readouterr().out == ""
    printer(["a", 0.12345])
    assert capsys.readouterr().out.splitlines() == [
        "what is below",
        "",
        "case    seconds",
        "------  -------",
        "a       0.123",
    ]
    printer(["b", None])
    printer(["too long", 2e6])  # is not cut
    assert capsys.readouterr().out.splitlines() == ["b       -", "too long  2e+06"]


def test_a_printer_has_a_width_and_every_row_a_cell_for_each_header():
    with pytest.raises(ValueError, match="shorter"):
        Printer("", ["case", "seconds"], [6])
    with pytest.raises(ValueError, match="longer"):
        Printer("", ["case", "seconds"], [6, 6])(["a"])


def test_rows_are_printed_above_a_progress_bar(monkeypatch):
    """A bar has no end of line: what follows it must start over, as a terminal does at a carriage return."""
    terminal = io.StringIO()
    monkeypatch.setattr(sys, "stdout", terminal)
    with tqdm(total=2, desc="bar", leave=False, file=terminal):
        Printer("title", ["case"], [4])(["a"])
    lines = terminal.getvalue().split("\n")
    assert [line.rpartition("\r")[2] for line in lines] == ["title", "", "case", "----", "a", ""]
    assert all("bar" in line for line in lines)
