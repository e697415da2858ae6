"""Plain text tables, whole or row by row."""

import sys
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import TypeVar

from tqdm import tqdm

from experiments.reports.digits import significant

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)


def grouped(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Return the items with the same key together, in their order."""
    groups: dict[K, list[T]] = defaultdict(list)
    for one in items:
        groups[key(one)].append(one)
    return groups


def table(headers: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return rows under headers: numbers to three digits and to the right, `None` as a dash, text to the left.

    Example:
        >>> print(table(["case", "seconds"], [["plane wave", 0.12345], ["step", None]]))
        case        seconds
        ----------  -------
        plane wave    0.123
        step              -
    """
    cells = [[cell_text(value) for value in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(headers, *cells, strict=True)]
    right = [all(not isinstance(row[i], str) for row in rows) for i in range(len(headers))]
    lines = [list(headers), ["-" * width for width in widths], *cells]
    return "\n".join(
        "  ".join(
            text.rjust(width) if to_right else text.ljust(width)
            for text, width, to_right in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )


class Printer:
    """A table that is printed row by row, as the rows come: above the progress bars, where there are any.

    Args:
        title: a line above the table.
        headers: of the columns.
        widths: of the columns at least, as the rows to come need it; a column is never narrower than its header.
    """

    def __init__(self, title: str, headers: Sequence[str], widths: Sequence[int]) -> None:
        self._widths = [max(len(header), width) for header, width in zip(headers, widths, strict=True)]
        self._lines = [title, "", self._line(headers), self._line(["-" * width for width in self._widths])]

    def __call__(self, row: Sequence[object]) -> None:
        """Print a row; the first one comes with title and headers."""
        for line in (*self._lines, self._line([cell_text(value) for value in row])):
            tqdm.write(line)
        sys.stdout.flush()
        self._lines = []

    def _line(self, cells: Sequence[str]) -> str:
        return "  ".join(cell.ljust(width) for cell, width in zip(cells, self._widths, strict=True)).rstrip()


def cell_text(value: object) -> str:
    """Return a value as a table shows it: numbers to three digits, thousands without an exponent, `None` as a dash."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else significant(value, 3)
    return str(value)
