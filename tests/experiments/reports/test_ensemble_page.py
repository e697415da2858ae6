"""Pages and figures of an ensemble, and how much a full setting is saved."""

import base64
import io
import math
import re
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import torch
from small import TARGET, TASK
from written_runs import write

import torch_zerohess as zh
from experiments.reports.ensemble_page import page, report
from experiments.reports.error_curves import plot, quartiles, styles_of
from experiments.reports.results import load as load_results
from experiments.reports.similarity import described, measures


def test_plot_draws_every_task(folder, capsys):
    plot(folder)
    path = folder / "bowl.png"
    assert capsys.readouterr().out.strip() == str(path)
    assert matplotlib.image.imread(path).std() > 0.01


def test_curves_are_steps_between_quartiles():
    lines = [(np.array([1.0, 4.0]), np.array([1e-1, 1e-3])), (np.array([2.0]), np.array([1e-2]))]
    positions, errors = quartiles(lines)
    assert positions.tolist() == [1.0, 2.0, 4.0]
    # (0.1, 1), (0.1, 0.01), (0.001, 0.01), a quarter, a half and three quarters of the way on a logarithmic axis.
    assert np.allclose(np.log10(errors.T), [[-0.75, -0.5, -0.25], [-1.75, -1.5, -1.25], [-2.75, -2.5, -2.25]])


def test_methods_have_one_style_in_all_figures(folder):
    write(folder, "cobyqa", 0, [1.0, 0.1], each=1)
    (folder / "bowl" / "cobyqa").rename(folder / "quad_cobyqa")
    (folder / "quad").mkdir()
    (folder / "quad_cobyqa").rename(folder / "quad" / "cobyqa")
    chosen = styles_of(load_results(folder))
    assert list(chosen) == ["cobyqa", "gaussian_process", "our_g"]
    assert len({(style["color"], style["linestyle"]) for style in chosen.values()}) == 3


def test_the_page_needs_nothing_else(folder):
    text = page(folder, {"bowl": TASK})
    assert "http" not in text
    assert not re.findall(r"<(?:script|link|iframe)", text)
    sources = re.findall(r"src='([^']*)'", text)
    images = [
        matplotlib.image.imread(io.BytesIO(base64.b64decode(source.removeprefix("data:image/png;base64,"))))
        for source in sources
    ]
    # Curves, the start, the results of run 0 of both methods, the target.
    assert len(images) == 1 + 1 + 2 + 1
    start, result, target = images[1], images[2], images[-1]
    assert np.array_equal(result, target)  # the runs above end at the solution
    pixels = np.round(255 * TASK.picture.of(TASK.start(0)).numpy())
    assert np.array_equal(np.round(255 * start[..., 0]), pixels)
    for part in ("60 1s 100%", "ValueError: no", "gaussian_process", TASK.title, "not shown: 1"):
        assert part in text


def test_pictures_say_how_far_they_are_from_the_target(folder, no_curves):
    text = page(folder, {"bowl": TASK})
    captions = dict(re.findall(r"<figcaption><b>([^<]*)</b><br>([^<]*)</figcaption>", text))
    start, target = TASK.picture.of(TASK.start(0)), TASK.picture.of(TARGET)
    decibels = -10 * math.log10(float((start - target).square().mean()))
    assert captions == {
        "start": f"PSNR {decibels:.1f} dB",  # too small for a window of SSIM
        "our_g": "PSNR inf dB",
        "gaussian_process": "PSNR inf dB",
        "target": "",
    }
    truth = replace(TASK.truth, measures=lambda x: {"distance": float(x[0] - TARGET[0])})
    without = replace(TASK, picture=None, truth=truth)
    text = page(folder, {"bowl": without})
    assert "PSNR" not in text
    assert re.findall(r"<b>([^<]*)</b><br>(distance [^<]*)<", text) == [
        ("start", f"distance {float(TASK.start(0)[0] - TARGET[0]):.3g}"),
        ("gaussian_process", "distance 0"),
        ("our_g", "distance 0"),
    ]


@pytest.mark.parametrize("shape", [(20, 16), (20, 16, 3)])
def test_measures_of_pictures(shape):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(shape, generator=generator, dtype=torch.float64)
    picture = (0.8 * target + 0.2 * torch.rand(shape, generator=generator)).clamp(0, 1)
    found = measures(picture, target)
    assert found["PSNR"] == pytest.approx(-10 * math.log10(float((picture - target).square().mean())))
    assert found["SSIM"] == pytest.approx(1 - float(zh.losses.ssim(target)(picture)))
    assert measures(target, target) == {"PSNR": math.inf, "SSIM": pytest.approx(1.0)}
    # What cannot be shown does not count.
    assert measures(picture + (picture == 1), target) == found
    assert measures(picture[:10], target[:10]).keys() == {"PSNR"}
    with pytest.raises(ValueError, match=r"picture must have the shape .*of the target, got \[19, 16"):
        measures(picture[1:], target)


def test_measures_as_text():
    assert described({"PSNR": 31.25, "SSIM": 0.98765, "d": 0.00123}) == "PSNR 31.2 dB, SSIM 0.988, d 0.00123"


def test_report_writes_the_page(folder, tmp_path, no_curves, capsys):
    report(folder)
    assert (folder / "report.html").read_text() == page(folder)
    report(folder, tmp_path / "other.html")
    assert (tmp_path / "other.html").read_text() == page(folder)
    report(folder, tmp_path / "new" / "one" / "page.html")
    assert (tmp_path / "new" / "one" / "page.html").read_text() == page(folder)
    with pytest.raises(SystemExit, match=r"out must be a file, .* got the folder .*new"):
        report(folder, tmp_path / "new")
