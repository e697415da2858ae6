"""The rows of `mutations.csv` fit the code, and `mutations.py` tells a change that is noticed from one that is not."""

import ast

import mutations
import pytest

ROWS = mutations.mutations()


def test_every_row_fits_the_code_and_the_tests():
    files = mutations.test_files()
    assert len(ROWS) > 1000
    assert len(set(ROWS)) == len(ROWS)
    for row in ROWS:
        text = (mutations.ROOT / row.file).read_text()
        changed = row.changed(text)
        assert changed != text, row
        if row.file.endswith(".py"):
            ast.parse(changed)
        assert {name.partition("[")[0] for name in row.names()} <= files.keys(), row


TEST = "test_the_shortest_vector_of_a_hull_is_a_corner_a_point_of_a_side_or_zero"


@pytest.mark.parametrize(
    ("code", "test", "word"),
    [
        ("_STEPS = 1", TEST, "noticed"),
        ("_STEPS = 101", TEST, "NOT NOTICED"),
        ("import no_such_module", TEST, "PYTEST ENDS WITH 4"),
        ("_STEPS = 1", f"{TEST}[no such case]", "PYTEST ENDS WITH 4 WITHOUT IT"),
    ],
)
def test_a_change_that_no_test_notices_is_reported(code, test, word, monkeypatch, capsys):
    noticed = word == "noticed"
    row = mutations.Mutation("torch_zerohess/linalg/hull.py", "`_STEPS`", "_STEPS = 100", code, test)
    monkeypatch.setattr(mutations, "mutations", lambda: [row])
    assert mutations.main("_STEPS") == int(not noticed)
    said = capsys.readouterr().out
    assert said.startswith(f"{word}: ")
    assert f"{int(noticed)} of 1 tests failed" in said
    assert mutations.main("no such text") == 1
