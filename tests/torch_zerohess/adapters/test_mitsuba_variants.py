"""Choice of the Mitsuba variant: a library that aborts must never take the caller with it."""

import ctypes.util
import os
import sys
import threading
from pathlib import Path

import pytest

import torch_zerohess as zh
from torch_zerohess.adapters import mitsuba_variants as adapter

ABORTING = [path for path in map(Path, ["/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1"]) if path.exists()]


def test_llvm_version_comes_from_the_name_or_the_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-18.so", "libLLVM.dylib", "libLLVMCore.so.20"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM.so.19.1")
    monkeypatch.setattr(adapter, "_FOLDERS", (str(tmp_path),))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    found = adapter.find_llvm()
    assert found is not None
    assert found.resolve().name == "libLLVM.so.19.1"
    for asked, chosen in (("libLLVM-18.so", "libLLVM-18.so"), ("libLLVM-15.so.1", found.name), ("none", found.name)):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / asked))
        again = adapter.find_llvm()
        assert again is not None
        assert again.name == chosen


def test_old_and_unknown_llvm_are_not_candidates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.dylib", "libLLVM.so"):
        (tmp_path / name).touch()
    monkeypatch.setattr(adapter, "_FOLDERS", (str(tmp_path),))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so"))
    assert adapter.find_llvm() is None


def test_without_mitsuba_the_reason_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    outcomes = adapter.variants()
    assert set(outcomes) == {"scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb"}
    assert all(not outcome.works and "pip install mitsuba" in outcome.reason for outcome in outcomes.values())


def test_bogus_llvm_does_not_work_and_the_caller_lives() -> None:
    outcome = adapter.probe("llvm_ad_rgb", Path("/nonexistent/libLLVM.so.19"))
    assert not outcome.works
    assert "LLVM" in outcome.reason


@pytest.mark.parametrize("library", [None, *ABORTING])
def test_a_child_that_aborts_does_not_reach_the_caller(library: Path | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in everywhere, and a real library that aborts where the machine has one."""
    if library is None:
        code = "import os, sys; sys.stderr.write('LLVM ERROR: no\\nat 0x1\\n'); os.abort()"
        monkeypatch.setattr(adapter, "_CHILD", code)
    outcome = adapter.probe("llvm_ad_rgb" if library else "stand-in for an aborting variant", library)
    assert not outcome.works
    assert "SIGABRT" in outcome.reason
    assert "LLVM ERROR" in outcome.reason


def test_a_child_that_hangs_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "_CHILD", "import time; time.sleep(60)")
    outcome = adapter.probe("stand-in for a hanging variant", timeout=0.2)
    assert outcome == adapter.Probe(False, "the test render did not end within 0.2 s")


def test_scalar_always_works_and_a_probe_is_remembered() -> None:
    outcomes = adapter.variants()
    assert outcomes["scalar_rgb"] == adapter.Probe(True, "")
    assert adapter.variants()["scalar_rgb"] is outcomes["scalar_rgb"]
    assert all(outcome.works or outcome.reason for outcome in outcomes.values())


def test_variants_are_tried_at_the_same_time_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    together, seen = threading.Barrier(len(adapter.CANDIDATES)), set()

    def probe(*arguments: object) -> adapter.Probe:
        together.wait(30)
        seen.add(arguments)
        return adapter.Probe(True, "")

    monkeypatch.setattr(adapter, "probe", probe)
    monkeypatch.setattr(adapter, "find_llvm", lambda: Path("libLLVM.so.19"))
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: "nvcuda.dll" if name == "nvcuda" else None)
    assert set(zh.doctor().mitsuba.values()) == {"works"}
    assert set(adapter.variants()) == {variant for variant, *_ in seen}
    assert len(seen) == len(adapter.CANDIDATES), "both ask for the same tries, which are remembered"


def test_what_auto_does_not_take_does_not_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "probe", lambda *_: adapter.Probe(True, ""))
    monkeypatch.setattr(adapter, "find_llvm", lambda: None)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    outcomes = adapter.variants()
    assert outcomes["scalar_rgb"].works
    assert outcomes["llvm_ad_rgb"] == adapter.Probe(False, "no LLVM 16 or newer was found")
    assert outcomes["cuda_ad_rgb"] == adapter.Probe(False, "no NVIDIA driver was found")
    assert adapter.select_variant().variant() == "scalar_rgb"


def test_select_returns_the_module_with_the_variant_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", os.environ.get("DRJIT_LIBLLVM_PATH", ""))
    assert adapter.select_variant("scalar_rgb", threads=1).variant() == "scalar_rgb"
    expected = "llvm_ad_rgb" if adapter.variants()["llvm_ad_rgb"].works else "scalar_rgb"
    assert adapter.select_variant().variant() == expected


def test_a_library_that_is_replaced_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "_FOLDERS", (str(tmp_path),))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", asked := str(tmp_path / "libLLVM-15.so.1"))
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.20.1"):
        (tmp_path / name).touch()
    with pytest.warns(
        UserWarning, match=rf"must name .* LLVM 16 or newer .*, got {asked}: .*libLLVM\.so\.20\.1 is used"
    ):
        adapter.select_variant("scalar_rgb")
    assert os.environ["DRJIT_LIBLLVM_PATH"] == str(tmp_path / "libLLVM.so.20.1")
    adapter.select_variant("scalar_rgb")  # the same one again
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", asked := str(tmp_path / "libLLVM.so.19.1"))
    adapter.select_variant("scalar_rgb")  # an own choice that qualifies stays
    assert os.environ["DRJIT_LIBLLVM_PATH"] == asked


def test_auto_falls_back_to_scalar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "find_llvm", lambda: None)
    assert adapter.select_variant().variant() == "scalar_rgb"


def test_explicit_variant_that_does_not_work_raises_with_the_reason() -> None:
    with pytest.raises(RuntimeError, match=r"'no_such_variant' does not work here: .*scalar_rgb"):
        adapter.select_variant("no_such_variant")
    with pytest.raises(ValueError, match="threads must be at least 1"):
        adapter.select_variant("scalar_rgb", threads=0)
    with pytest.raises(TypeError, match="threads must be an integer, got '2'"):
        adapter.select_variant("scalar_rgb", threads="2")
