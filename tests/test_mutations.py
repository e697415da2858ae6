"""The rows of `mutations.csv` fit the code, and `mutations.py` tells a change that is noticed from one that is not."""

import ast
import subprocess

import mutations

ROWS = mutations.mutations()


def test_every_row_fits_the_code_and_the_tests():
    files = mutations.test_files()
    assert len(ROWS) > 1000
    assert len(set(ROWS)) == len(ROWS)
    texts = {name: (mutations.ROOT / name).read_text() for name in {row.file for row in ROWS}}
    for row in ROWS:
        text = texts[row.file]
        changed = row.changed(text)
        assert changed != text, row
        if row.file.endswith(".py"):
            ast.parse(changed)
        assert {name.partition("[")[0] for name in row.names()} <= files.keys(), row


FILES = {
    "steps.py": "STEPS = 100\n",
    "tests/test_steps.py": "import steps\n\ndef test_there_are_many_steps():\n    assert steps.STEPS > 99\n",
}
TEST = "test_there_are_many_steps"
CHANGES = [
    ("STEPS = 1", TEST, "noticed"),
    ("STEPS = 101", TEST, "NOT NOTICED"),
    ("import no_such_module", TEST, "PYTEST ENDS WITH 4"),
    ("STEPS = 1", f"{TEST}[no such case]", "PYTEST ENDS WITH 4 WITHOUT IT"),
]


def test_a_change_that_no_test_notices_is_reported(tmp_path, monkeypatch, capsys):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "."], cwd=tmp_path, check=True)
    rows = [mutations.Mutation("steps.py", "`STEPS`", "STEPS = 100", code, test) for code, test, _ in CHANGES]
    monkeypatch.setattr(mutations, "ROOT", tmp_path)
    monkeypatch.setattr(mutations, "mutations", lambda: rows)
    assert mutations.main("STEPS") == 1
    *said, last = capsys.readouterr().out.splitlines()
    assert said == [f"{word}: steps.py, `STEPS`, by {test}" for _, test, word in CHANGES]
    assert last == "4 changes; 1 of 4 tests failed, as they should"
    assert (tmp_path / "steps.py").read_text() == FILES["steps.py"]
    monkeypatch.setattr(mutations, "mutations", lambda: rows[:1])
    assert mutations.main("STEPS") == 0
    assert mutations.main("no such text") == 1


def test_a_test_of_this_tree_passes_in_a_copy(tmp_path):
    mutations.copy(tmp_path)
    test = "test_the_shortest_vector_of_a_hull_is_a_corner_a_point_of_a_side_or_zero"
    assert mutations.status(test, tmp_path, mutations.test_files()) == 0
