"""The file of a search: what goes wrong with it is said once, and takes neither the result nor another error."""

import errno
import math
import os
import shutil
import threading
import warnings

import numpy as np
import pytest
import torch
from searches import tilted, zeros

import torch_zerohess as zh
from torch_zerohess.minimization import running
from torch_zerohess.minimization.checkpoint import Checkpoint

SETTINGS = {"sigma": 2.0, "seed": 0, "max_evaluations": 20}


def interrupt():
    raise KeyboardInterrupt


def then(event, call):
    """A function that calls `event` in the given call of it (from 0)."""
    calls = []

    def fn(z):
        calls.append(z)
        if len(calls) - 1 == call:
            event()
        return tilted(z)

    return fn


@pytest.mark.parametrize("pause", [0.0, math.inf])
def test_a_file_that_cannot_be_written_does_not_take_the_result(pause, tmp_path, monkeypatch):
    """The folder vanishes in the third call, before the file is written after every call, or at the end alone."""
    monkeypatch.setattr(running, "_PAUSE", pause)
    folder = tmp_path / "folder"
    folder.mkdir()
    path = folder / "search.pt"
    with pytest.warns(UserWarning, match=r"checkpoint '.*search\.pt' cannot be written, .*FileNotFound") as said:
        fit = zh.minimize(then(lambda: shutil.rmtree(folder), 2), zeros(2), checkpoint=path, **SETTINGS)
    assert len(said) == 1
    whole = zh.minimize(tilted, zeros(2), **SETTINGS)
    assert (fit.status, fit.message) == (whole.status, whole.message)
    assert torch.equal(fit.points, whole.points)


def test_a_file_gets_its_name_when_its_bytes_are_on_the_disk(tmp_path, monkeypatch):
    path, sizes = tmp_path / "search.pt", []

    def fsync(descriptor):
        assert not path.exists()
        sizes.append(os.fstat(descriptor).st_size)

    monkeypatch.setattr(os, "fsync", fsync)
    Checkpoint(path).write({"values": zeros(1000)})
    assert sizes == [path.stat().st_size]


def test_a_file_that_cannot_be_written_does_not_take_the_place_of_the_own_error(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()

    def fails():
        shutil.rmtree(folder)
        raise ZeroDivisionError

    with pytest.warns(UserWarning, match="cannot be written"), pytest.raises(ZeroDivisionError) as caught:
        zh.minimize(then(fails, 2), zeros(2), checkpoint=folder / "search.pt", **SETTINGS)
    assert caught.value.minimum.status == "failed"


def test_after_a_write_that_failed_the_next_one_is_tried(tmp_path, monkeypatch):
    """The disk is full for two writes. The file before them stays, and no draft is left."""
    monkeypatch.setattr(running, "_PAUSE", 0.0)
    path, save, calls, left = tmp_path / "search.pt", torch.save, [], []

    def full_at_times(content, file):
        calls.append(content)
        if len(calls) in (3, 4):
            file.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        save(content, file)
        if len(calls) == 5:
            left.extend(os.listdir(tmp_path))

    monkeypatch.setattr(torch, "save", full_at_times)
    with pytest.warns(UserWarning, match="No space left on device") as said:
        fit = zh.minimize(tilted, zeros(2), checkpoint=path, **SETTINGS)
    assert len(said) == 1
    assert len(left) == 2  # the file, and the draft of the next one
    assert os.listdir(tmp_path) == ["search.pt"]
    assert torch.equal(torch.load(path)["points"], fit.points)


def test_ctrl_c_leaves_no_draft(tmp_path, monkeypatch):
    def interrupted(content, file):
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Checkpoint(tmp_path / "search.pt").write({})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("other", ["process", "thread"])
def test_two_writers_have_a_draft_each(other, tmp_path, monkeypatch):
    """One writes the whole file while another is about to."""
    path, save, begun = tmp_path / "search.pt", torch.save, []

    def write_of_the_other():
        Checkpoint(path).write({"of": "the other"})

    def interleaved(content, file):
        if not begun:
            begun.append(content)
            if other == "thread":
                thread = threading.Thread(target=write_of_the_other)
                thread.start()
                thread.join()
            else:
                with monkeypatch.context() as patch:
                    patch.setattr(os, "getpid", lambda: 1)
                    write_of_the_other()
        save(content, file)

    monkeypatch.setattr(torch, "save", interleaved)
    Checkpoint(path).write({"of": "the first"})
    assert torch.load(path) == {"of": "the first"}
    assert os.listdir(tmp_path) == ["search.pt"]


def test_another_process_that_writes_the_file_is_noticed_once(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "_PAUSE", 0.0)
    path = tmp_path / "search.pt"

    def written():
        torch.save({"of": "another"}, path)

    f = then(written, 2)
    message = r"checkpoint '.*search\.pt' has changed since this search .*: another process writes it, too"
    with pytest.warns(UserWarning, match=message) as said:
        zh.minimize(lambda z: (written(), f(z))[1], zeros(2), checkpoint=path, **SETTINGS)
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zh.minimize(tilted, zeros(2), checkpoint=path, **{**SETTINGS, "max_evaluations": 30})
        path.unlink()  # nobody else has written it
        zh.minimize(then(path.unlink, 3), zeros(2), checkpoint=path, **SETTINGS)


def test_a_write_that_was_interrupted_is_none_of_another_process(tmp_path, monkeypatch):
    """Ctrl-C comes before or after the draft takes the place of the file."""
    replace = type(tmp_path).replace
    for after in (False, True):
        file = Checkpoint(tmp_path / f"{after}.pt")
        file.write({"k": 0})

        def interrupted(draft, path, after=after):
            if after:
                replace(draft, path)
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(type(tmp_path), "replace", interrupted)
            with pytest.raises(KeyboardInterrupt):
                file.write({"k": [1] * 1000})
        file.write({"k": 2})


@pytest.mark.parametrize(("before", "noise"), [(None, 0.3), (0.1, 0.3), (0.1, 0.0), (0.1, 0.1), (0.1, None)])
def test_noise_where_there_was_none_begins_a_new_search_that_keeps_the_evaluations(before, noise, tmp_path):
    """The file has noise that was measured, none, or noise that was given."""
    path, fewer = tmp_path / "search.pt", {**SETTINGS, "checkpoint": tmp_path / "search.pt"}
    part = zh.minimize(tilted, zeros(2), noise=before, **fewer)
    more = {**fewer, "max_evaluations": 40}
    fit = zh.minimize(tilted, zeros(2), noise=noise, **more)
    assert fit.noise == (0.1 if noise is None else noise)
    assert (fit.value_error > 0) == (fit.noise > 0)
    assert torch.equal(fit.points[: part.evaluations], part.points)
    again = fit.points[part.evaluations].tolist() == [0.0, 0.0]
    assert again == (noise is not None and bool(noise) != bool(before))
    assert torch.load(path)["noise"] == fit.noise
    assert torch.equal(zh.minimize(tilted, zeros(2), noise=noise, **more).points, fit.points)


@pytest.mark.parametrize("call", [1, 3, 4, 9])
def test_noise_that_is_given_after_an_interruption(call, tmp_path):
    """Every value is kept: of the first batch, the measurement of noise, and what follows it."""
    f, count = then(interrupt, call), []
    settings = {"sigma": 2.0, "seed": 0, "vectorized": False, "checkpoint": tmp_path / "search.pt"}

    def fn(x):
        value = f(x[None])[0]
        count.append(value)
        return value

    assert zh.minimize(fn, zeros(2), **settings).evaluations == call
    fit = zh.minimize(fn, zeros(2), noise=0.3, max_evaluations=30, **settings)
    assert (fit.noise, fit.evaluations) == (0.3, 30)
    assert fit.values.tolist() == [float(one) for one in count]


def test_noise_and_limits_of_numpy_are_plain_numbers_in_the_file(tmp_path):
    given = {"noise": np.float64(0.1), "restarts": np.int64(0), "tolerance": np.float64(0.1)}
    for _ in range(2):
        fit = zh.minimize(tilted, zeros(2), checkpoint=tmp_path / "search.pt", **SETTINGS, **given)
    assert fit.noise == 0.1


@pytest.mark.parametrize(("name", "value"), [("restarts", 3), ("restarts", None), ("tolerance", 1e-4)])
def test_limits_that_a_search_has_come_to_cannot_be_others(name, value, tmp_path):
    """They are honoured where the search goes on."""
    settings = {"restarts": 0, "tolerance": 0.05, **SETTINGS}
    path = tmp_path / "search.pt"
    fit = zh.minimize(tilted, zeros(2), checkpoint=path, **settings)
    assert fit.evaluations < 20
    message = rf"{name} must be {settings[name]} as there, where the search is done \(.*\), got {value}: minimise from"
    with pytest.raises(ValueError, match=message):
        zh.minimize(tilted, zeros(2), checkpoint=path, **{**settings, name: value})
    assert zh.minimize(tilted, zeros(2), checkpoint=path, **settings).message == fit.message
    path.unlink()
    zh.minimize(tilted, zeros(2), checkpoint=path, **{**settings, "max_evaluations": 7})
    zh.minimize(tilted, zeros(2), checkpoint=path, **{**settings, name: value})
