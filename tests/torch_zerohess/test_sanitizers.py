"""The C++ kernels, compiled without torch and run under the address and undefined-behaviour sanitizers."""

import shutil
import subprocess
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1] / "csrc"
FLAGS = ["-std=c++20", "-g", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def compiled(folder: Path, source: str, *flags: str) -> Path:
    if shutil.which("g++") is None:
        pytest.fail("this test compiles C++: install g++ (Debian: apt-get install g++)")
    program = folder / "program"
    command = ["g++", *FLAGS, *SANITIZERS, *flags, str(SOURCES / source), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


@pytest.mark.parametrize("source", ["core_test.cpp", "sparse_test.cpp"])
def test_kernels_under_sanitizers(source: str, tmp_path: Path) -> None:
    done = subprocess.run([compiled(tmp_path, source, "-O1")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.mark.parametrize("source", ["core_fuzz.cpp", "sparse_fuzz.cpp"])
def test_random_inputs_under_sanitizers(source: str, tmp_path: Path) -> None:
    """The inputs of a fuzzer, without its search: tests/README.md says what they reach of what it reached."""
    done = subprocess.run([compiled(tmp_path, source, "-O0", "-DREPLAY=400")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def test_sanitizers_are_on(tmp_path: Path) -> None:
    """A run that cannot fail would prove nothing: an overrun of one element must be caught."""
    wrong = tmp_path / "overrun.cpp"
    wrong.write_text(
        f'#include "{SOURCES.parents[1] / "csrc" / "reduce.h"}"\n'
        "int main() { std::vector<double> u(7); return int(zerohess::dot(u.data(), u.data(), 8)); }\n"
    )
    program = tmp_path / "overrun"
    subprocess.run(["g++", *FLAGS, *SANITIZERS, str(wrong), "-o", str(program)], check=True)
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode != 0
    assert "heap-buffer-overflow" in done.stderr
