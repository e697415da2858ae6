"""Plain text tables."""

from experiments.reports.tables import table


def test_table_aligns_numbers() -> None:
    text = table(["case", "n"], [["a", 1.23456], ["bb", None], ["c", 12345.6]])
    assert text.splitlines() == ["case      n", "----  -----", "a      1.23", "bb        -", "c     12346"]
