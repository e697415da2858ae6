"""Parts of a study: measured once, kept at once, and a line that was cut off is measured again."""

from dataclasses import dataclass

import pytest

from experiments.ensembles import provenance
from experiments.ensembles.kept_parts import NAME, KeptParts


@dataclass(frozen=True)
class Row:
    where: str
    error: float


def test_a_part_is_measured_once_for_each_of_its_settings(tmp_path) -> None:
    calls = []

    def measure(where: str) -> list[Row]:
        calls.append(where)
        return [Row(where, 0.1 + 0.2), Row(where, float("inf"))]

    kept = KeptParts(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    first = kept.rows({"a": 1, "b": [2]}, Row, lambda: measure("here"))
    assert kept.rows({"b": [2], "a": 1}, Row, lambda: measure("again")) == first
    kept.rows({"a": 1, "b": [3]}, Row, lambda: measure("there"))
    again = KeptParts(tmp_path / "new")
    assert again.rows({"a": 1, "b": [2]}, Row, lambda: measure("never")) == first  # bit for bit
    assert calls == ["here", "there"]
    assert (tmp_path / "new" / "command.json").is_file()


def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match="out must be a folder that can be written"):
        KeptParts(tmp_path / "file")


def test_rows_of_other_code_are_measured_again(tmp_path, monkeypatch) -> None:
    """Of another commit, or of other changes to the same one."""
    code = {"commit": "one", "clean": True}
    monkeypatch.setattr(provenance, "code", lambda: code)
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    source = tmp_path / "csrc" / "kernel.cpp"
    source.parent.mkdir()

    def measured(commit: str, clean: bool, text: str) -> float:
        code.update(commit=commit, clean=clean)
        source.write_text(text)
        number = len(seen)
        (row,) = KeptParts(tmp_path / "out").rows({"k": 1}, Row, lambda: [Row("", number)])
        seen.append(row.error)
        return row.error

    seen: list[float] = []
    steps = [("one", True, "a"), ("two", True, "a"), ("one", False, "b"), ("one", False, "c"), (None, None, "c")]
    assert [measured(*step) for step in steps] == [0, 1, 2, 3, 4]
    assert [measured(*step) for step in steps] == [0, 1, 2, 3, 4]


def test_what_a_kill_cut_off_is_measured_again(tmp_path) -> None:
    kept = KeptParts(tmp_path)
    kept.rows({"k": 1}, Row, lambda: [Row("one", 1.0)])
    kept.rows({"k": 2}, Row, lambda: [Row("two", 2.0)])
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes()[:-5])
    again = KeptParts(tmp_path)
    assert again.rows({"k": 1}, Row, list) == [Row("one", 1.0)]
    assert again.rows({"k": 2}, Row, lambda: [Row("new", 3.0)]) == [Row("new", 3.0)]
    assert KeptParts(tmp_path).rows({"k": 2}, Row, list) == [Row("new", 3.0)]


def test_a_broken_line_before_others_is_named(tmp_path) -> None:
    (tmp_path / NAME).write_text("what is this\n")
    with pytest.raises(SystemExit, match="not a part of a study; delete the file"):
        KeptParts(tmp_path)
