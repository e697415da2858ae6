"""Change one rule of the code at a time, and see whether the test that is named for it fails.

`python tests/mutations.py TEXT ...` tries the rows of `mutations.csv` that contain every TEXT; without one, all rows.
It works in a copy of the tree, in which a test must pass before the change, and fail with it. A test that cannot be
run then, as in a file that cannot be imported, has not noticed. The exit status is 1 if a test did not notice a change.
"""

import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Mutation(NamedTuple):
    """A row: `code` of `file` is replaced by `mutation` wherever it stands; then the `tests` fail, each of them."""

    file: str
    rule: str
    code: str
    mutation: str
    tests: str

    def names(self) -> list[str]:
        """Return the names of the tests, those of single cases as `test_name[case]`."""
        return self.tests.split("; ")

    def changed(self, text: str) -> str:
        """Return the text of the file with the change."""
        if self.code not in text:
            raise ValueError(f"mutations.csv: {self.file} does not contain {self.code!r}")
        return text.replace(self.code, self.mutation)


def mutations() -> list[Mutation]:
    """Return all rows."""
    with open(ROOT / "tests" / "mutations.csv", newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == Mutation._fields
    return [Mutation(*row) for row in rows]


def test_files() -> dict[str, list[str]]:
    """Return the files that define a test, by its name, as paths from the root."""
    files: dict[str, list[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for name in re.findall(r"^ *def (test_\w+)", path.read_text(), re.MULTILINE):
            files.setdefault(name, []).append(str(path.relative_to(ROOT)))
    return files


def copy(tree: Path) -> None:
    """Copy the files that git knows, and the C++ extension, to an empty folder."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    built = [str(path.relative_to(ROOT)) for path in (ROOT / "torch_zerohess").glob("_C*.so")]
    for name in listed.split("\0")[:-1] + built:
        if (ROOT / name).exists():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tree / name)


def run(tree: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run python in the copy, with the package of the copy."""
    changes = {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    return subprocess.run(
        [sys.executable, *command], cwd=tree, env=os.environ | changes, capture_output=True, text=True, check=False
    )


def build(tree: Path) -> None:
    """Build the C++ extension of the copy."""
    result = run(tree, "setup.py", "-q", "build_ext", "--inplace", "--force")
    if result.returncode:
        raise RuntimeError(f"the C++ extension does not compile:\n{result.stderr}")


def status(name: str, tree: Path, files: dict[str, list[str]]) -> int:
    """Run a test in the copy, and return the exit status of pytest: 0 if it passes, 1 if it fails, or another one."""
    nodes = [f"{file}::{name}" for file in files[name.partition("[")[0]]]
    return run(tree, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *nodes).returncode


def outcomes(
    mutation: Mutation, tree: Path, files: dict[str, list[str]], before: dict[str, int]
) -> Iterator[tuple[str, str]]:
    """Change the copy; yield for each test what came of it, "noticed" if all is well.

    before: exit statuses without a change, by test; missing ones are added.
    """
    for name in mutation.names():
        if name not in before:
            before[name] = status(name, tree, files)
    path = tree / mutation.file
    text = path.read_text()
    compiled = mutation.file.startswith("csrc/")
    try:
        path.write_text(mutation.changed(text))
        if compiled:
            build(tree)
        for name in mutation.names():
            if before[name]:
                yield name, f"PYTEST ENDS WITH {before[name]} WITHOUT IT"
                continue
            code = status(name, tree, files)
            yield name, {0: "NOT NOTICED", 1: "noticed"}.get(code, f"PYTEST ENDS WITH {code}")
    finally:
        path.write_text(text)
        if compiled:
            build(tree)


def main(*texts: str) -> int:
    """Try the rows that contain every text, print a line for each test, and return the exit status."""
    chosen = [one for one in mutations() if all(text in "\n".join(one) for text in texts)]
    survivors, tests, before = 0, 0, dict[str, int]()
    with tempfile.TemporaryDirectory() as folder:
        copy(Path(folder))
        for mutation in chosen:
            for name, word in outcomes(mutation, Path(folder), test_files(), before):
                tests, survivors = tests + 1, survivors + (word != "noticed")
                print(f"{word}: {mutation.file}, {mutation.rule}, by {name}", flush=True)
    print(f"{len(chosen)} changes; {tests - survivors} of {tests} tests failed, as they should")
    return int(survivors > 0 or not chosen)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
