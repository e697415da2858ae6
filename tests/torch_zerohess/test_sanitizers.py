"""The C++ kernels, compiled without torch and run under sanitizers: addresses, undefined behaviour, threads."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1] / "csrc"
KERNELS = SOURCES.parents[1] / "csrc"
FLAGS = ["-std=c++20", "-O0", "-g", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
"""With -O1, sparse_test.cpp takes four times as long to compile."""
ADDRESSES = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
THREADS = ["-fsanitize=thread", "-pthread"]


def compiled(folder: Path, source: Path, *flags: str) -> Path:
    if shutil.which("g++") is None:
        pytest.fail("this test compiles C++: install g++ (Debian: apt-get install g++)")
    program = folder / "program"
    command = ["g++", *FLAGS, *flags, str(source), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


@pytest.mark.parametrize("source", ["core_test.cpp", "sparse_test.cpp"])
def test_kernels_under_sanitizers(source: str, tmp_path: Path) -> None:
    program = compiled(tmp_path, SOURCES / source, *ADDRESSES)
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.mark.parametrize("source", ["core_fuzz.cpp", "sparse_fuzz.cpp"])
def test_random_inputs_under_sanitizers(source: str, tmp_path: Path) -> None:
    """The inputs of a fuzzer, without its search: tests/README.md says what they reach of what it reached."""
    program = compiled(tmp_path, SOURCES / source, *ADDRESSES, "-DREPLAY=400")
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def test_operators_write_no_element_twice_at_a_time(tmp_path: Path) -> None:
    """The operators themselves, with a stand-in for torch, whose headers are empty files here."""
    for file in KERNELS.iterdir():
        for header in re.findall(r"#include <(torch/.*|Python\.h)>", file.read_text()):
            (tmp_path / header).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / header).touch()
    program = compiled(tmp_path, SOURCES / "threads_test.cpp", *THREADS, f"-I{tmp_path}")
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:4000]


WRONG = {
    "heap-buffer-overflow": (
        ADDRESSES,
        '#include "reduce.h"\n'
        "int main() { std::vector<double> u(7); return int(zerohess::dot(u.data(), u.data(), 8)); }\n",
    ),
    "data race": (
        THREADS,
        "#include <thread>\n"
        "int main() { int n = 0; std::thread other([&] { ++n; }); ++n; other.join(); return n - 2; }\n",
    ),
}


@pytest.mark.parametrize("expected", WRONG)
def test_sanitizers_are_on(expected: str, tmp_path: Path) -> None:
    """A run that cannot fail would prove nothing: an overrun of one element, and one sum of two threads."""
    flags, text = WRONG[expected]
    wrong = tmp_path / "wrong.cpp"
    wrong.write_text(text)
    program = compiled(tmp_path, wrong, *flags, f"-I{KERNELS}")
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode != 0
    assert expected in done.stderr
