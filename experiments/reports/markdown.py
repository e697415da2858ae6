"""Tables, numbers and shares as Markdown."""

from collections.abc import Sequence

from experiments.reports.digits import significant


def markdown(headers: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table, numbers to three digits."""
    lines = [headers, ["---"] * len(headers), *([number(value) for value in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: object) -> str:
    """Return a value as text: numbers to three digits, from a thousand on as integers; nothing where there is none.

    Example:
        >>> number(12.3456), number(81540.0), number(0.00012), number("text")
        ('12.3', '81 540', '0.00012', 'text')
    """
    if value is None or (isinstance(value, float) and value != value):
        return ""
    if isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool)):
        return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else significant(value, 3)
    return str(value)


def whole_percent(share: float) -> str:
    """Return a share as text, without decimals: `95 %`."""
    return f"{100 * share:.0f} %"
