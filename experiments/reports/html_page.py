"""Self-contained HTML pages: what reports and galleries share."""

import html
from collections.abc import Sequence

from experiments.reports.tables import cell_text

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .15em .8em; border-bottom: 1px solid #ddd }
td, th { text-align: left } td { white-space: nowrap; font-variant-numeric: tabular-nums }
.wide { overflow-x: auto } figure { display: inline-block; vertical-align: top } figcaption { font-size: 13px }
"""


def html_page(title: str, style: str, body: str) -> str:
    """Return a page under a heading; `style` comes on top of what all pages have."""
    return (
        f"<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><title>{html_text(title)}</title>"
        f"<style>{_STYLE}{style}</style></head><body><h1>{html_text(title)}</h1>{body}</body></html>\n"
    )


def html_table(headers: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return rows under headers, in a box of its own width that scrolls."""
    head = "".join(f"<th>{html_text(name)}</th>" for name in headers)
    body = "".join("<tr>" + "".join(f"<td>{html_text(value)}</td>" for value in row) + "</tr>" for row in rows)
    return f"<div class='wide'><table><tr>{head}</tr>{body}</table></div>"


def html_text(value: object) -> str:
    """Return a value, escaped, as `tables` shows it."""
    return html.escape(cell_text(value), quote=True)
