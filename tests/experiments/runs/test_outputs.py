"""Where commands may write is checked before they measure anything."""

import pytest

from experiments.runs.outputs import check_file, check_folder


@pytest.fixture
def taken(tmp_path):
    (tmp_path / "file").touch()
    return tmp_path / "file"


def test_a_folder_that_is_there_or_can_be_made(tmp_path) -> None:
    for out in (tmp_path, tmp_path / "a" / "b"):
        check_folder(out)
        check_file(out / "rows.json")
    check_file(None)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written(taken) -> None:
    too_long = taken.parent / ("a" * 300)
    (taken.parent / "link").symlink_to("nowhere")
    for out, reason in (
        (taken, "Not a directory"),
        (taken / "a" / "b", "Not a directory"),
        (taken.parent / "link", "No such file or directory"),
        (too_long, "File name too long"),
    ):
        with pytest.raises(SystemExit) as refused:
            check_folder(out)
        assert str(refused.value) == f"out must be a folder that can be written, got {out}: {reason}"


def test_a_file_that_cannot_be_written(taken) -> None:
    for out, reason in ((taken.parent, "Is a directory"), (taken / "rows.json", "Not a directory")):
        with pytest.raises(SystemExit) as refused:
            check_file(out)
        assert str(refused.value) == f"out must be a file that can be written, got {out}: {reason}"
