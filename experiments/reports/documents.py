"""`python -m experiments readme`: stored tables in the documents, between marks.

    <!-- table: NAME [option=value ...] -->      a table of experiments/results/NAME.csv, up to <!-- end -->
    <!-- value: NAME COLUMN [column=value ...] -->12.5<!-- /value -->      a number of the one row that has these values

What is between the marks is written by the command. Marks in code are left alone. Options of a table:

- medians of fits: `tasks=`, `methods=` (names with commas between them), `metric=image|parameter`, `level=90|99|99.9`,
  `show=both|evaluations|seconds`, `share=plain|interval`, `quartiles=hide|show`, `worst=hide|show`,
  `titles=show|hide`;
- networks: `tasks=`, `methods=`, `titles=show|hide`;
- `speed_up` in place of a name: mean ratios of methods to `reference=` over the tables in `of=`, and `methods=`;
- `table_2` in place of a name: the ratios of the source's Table 2 beside our ratios from the tables in `of=`; `tasks=`,
  `metric=`;
- a study: `columns=`, and `column=value` for the rows to show;
- a study with `across=COLUMN rows=COLUMN show=COLUMN`: a column per value of the first one, a row per value of the
  second, and in each cell the numbers of the third;
- any: `origin=full|commit`, where `commit` leaves out machine and command.
"""

import re
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from experiments.reports.document_tables import Query, rows_of, table_of
from experiments.reports.markdown import number

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("README.md", "experiments/README.md", "torch_zerohess/README.md", "tests/README.md")
_CODE = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)
_TABLE = re.compile(r"^<!-- table: (.*?) -->\n(.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)
_VALUE = re.compile(r"(?<!`)<!-- value: (.*?) -->(.*?)<!-- /value -->", re.DOTALL)


def readme(
    documents: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FILE...]")] = (),
    /,
    check: bool = False,
) -> None:
    """Write the tables and numbers of the documents from experiments/results/*.csv.

    Args:
        documents: Markdown files; all of the repository if not given.
        check: write nothing, and fail where a document differs from the files.
    """
    paths = documents or tuple(path for name in DOCUMENTS if (path := ROOT / name).exists())
    wrong = []
    for path in paths:
        if not path.is_file():
            raise SystemExit(f"FILE must be a Markdown file, got {path}")
        text = path.read_text(encoding="utf-8")
        new = filled(text)
        if new == text:
            print(f"{path}: as it should be")
        elif check:
            wrong += [f"{path}: {one}" for one in differences(text)]
        else:
            path.write_text(new, encoding="utf-8")
            print(f"{path}: written")
    if wrong:
        raise SystemExit("\n".join([*wrong, "run `python -m experiments readme`"]))


def filled(text: str) -> str:
    """Return a document with its tables and numbers as they are stored."""
    parts = _CODE.split(text)  # every second one is code
    for pattern, new in _MARKS:
        parts[::2] = [pattern.sub(new, part) for part in parts[::2]]
    return "".join(parts)


def differences(text: str) -> list[str]:
    """Return the marks of a document whose content differs from the stored results."""
    marks = [(match, new) for part in _CODE.split(text)[::2] for mark, new in _MARKS for match in mark.finditer(part)]
    return [match[0].splitlines()[0] for match, new in marks if new(match) != match[0]]


def _with_table(match: "re.Match[str]") -> str:
    name, *options = shlex.split(match[1])
    return f"<!-- table: {match[1]} -->\n{table_of(name, Query.of(options))}\n<!-- end -->"


def _with_value(match: "re.Match[str]") -> str:
    name, column, *options = shlex.split(match[1])
    rows = rows_of(name, Query.of(options))
    if len(rows) != 1 or column not in rows:
        raise SystemExit(f"value must name a column and one row of {name}, got {match[1]} with {len(rows)} rows")
    return f"<!-- value: {match[1]} -->{number(rows[column].iloc[0])}<!-- /value -->"


_MARKS = ((_TABLE, _with_table), (_VALUE, _with_value))
