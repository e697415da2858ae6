"""Stored tables have their origins once, in one file of all tables."""

import csv

import pandas as pd
import pytest

from experiments.reports import result_files
from experiments.reports.result_files import ORIGIN, read, write

RUNS = dict(
    zip(ORIGIN, ("fast", 15.0, "wall", 40, "01234567", "2026-11-30", "a machine, 2 cores", "run a"), strict=True)
)
STUDY = {one: RUNS[one] for one in ("commit", "date", "machine")} | {"command": "study b"}


@pytest.fixture
def stored(tmp_path, monkeypatch):
    monkeypatch.setattr(result_files, "RESULTS", tmp_path)
    return tmp_path


def lines(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_a_table_is_read_as_it_was_written(stored):
    runs = pd.DataFrame({"task": ["a", "b"], "seconds": [1.5, None]}).assign(**RUNS)
    runs.loc[1, ["first_run", "limit"]] = (60, None)
    study = pd.DataFrame({"error": [0.25]}).assign(**STUDY)
    write(runs, "runs")
    write(study, "study")
    pd.testing.assert_frame_equal(read("runs"), runs)
    pd.testing.assert_frame_equal(read("study"), study)


def test_an_origin_is_stored_once(stored):
    first = pd.DataFrame({"error": [1, 2, 3]}).assign(**STUDY)
    write(first, "first")
    write(first.head(1), "second")
    (origin,) = lines(stored / "origins.csv")
    assert origin == dict.fromkeys(ORIGIN, "") | STUDY | {"id": origin["id"]}
    assert lines(stored / "first.csv") == [{"error": str(error), "origin": origin["id"]} for error in (1, 2, 3)]


def test_an_origin_that_no_table_has_is_removed(stored):
    write(pd.DataFrame({"error": [1]}).assign(**STUDY), "first")
    write(pd.DataFrame({"error": [1]}).assign(**STUDY), "second")
    for name, commands in (("first", {"study b", "study c"}), ("second", {"study c"})):
        write(pd.DataFrame({"error": [1]}).assign(**(STUDY | {"command": "study c"})), name)
        assert {one["command"] for one in lines(stored / "origins.csv")} == commands


def test_ids_do_not_depend_on_what_was_stored_before(stored):
    """Two branches that store the same tables in another order have the same files."""
    tables = {
        f"table_{k}": pd.DataFrame({"error": [k]}).assign(**(STUDY | {"command": f"study {k}"})) for k in range(8)
    }
    for name, table in tables.items():
        write(table, name)
    found = {one.name: one.read_text() for one in stored.iterdir()}
    for one in stored.iterdir():
        one.unlink()
    for name in reversed(tables):
        write(tables[name], name)
        write(read(name), name)
    assert {one.name: one.read_text() for one in stored.iterdir()} == found


def test_the_origins_are_no_table_and_a_lost_one_is_named(stored):
    write(pd.DataFrame({"error": [1]}).assign(**STUDY), "study")
    with pytest.raises(SystemExit, match=r"table must be one .*, study, got origins"):
        read("origins")
    with pytest.raises(SystemExit, match="name must not be that of the file of origins"):
        write(read("study"), "origins")
    (stored / "origins.csv").unlink()
    with pytest.raises(SystemExit, match=r"origins.csv must have all origins, has none of [0-9a-f]{8}$"):
        read("study")


def test_the_files_of_this_tree_have_the_origins_that_they_need():
    used = {row["origin"] for path in result_files.RESULTS.glob("*.csv") for row in lines(path) if "origin" in row}
    assert [one["id"] for one in lines(result_files.RESULTS / "origins.csv")] == sorted(used)
