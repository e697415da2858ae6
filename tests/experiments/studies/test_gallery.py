"""Traces, pictures and animations of optimisations whose course is known, and the command that shows them."""

import re
from dataclasses import replace

import pytest
import small
import torch
from PIL import Image, ImageSequence

from experiments.problems import catalogue
from experiments.problems.rendered import Setting, rendered
from experiments.problems.task import Task
from experiments.problems.tasks import caustic, quad
from experiments.reports import animation, supplement_figures
from experiments.reports.animation import (
    Look,
    Trace,
    captioned,
    finer,
    frames,
    look,
    save,
    shown_rows,
    tile,
    together,
)
from experiments.runs.records import Outcome, Record
from experiments.studies.gallery import gallery, recommended, trace, traces
from truths import vector

ENDED = Outcome("t", "m", 0, "stopped", "", 1.0, 1.0, 10, 0, [])


def made(points, evaluations=None, task=small.TASK):
    counts = evaluations or [2 * k for k in range(len(points))]
    rows = [
        Record("t", "m", 0, k, 0.1 * k, n, None, None, task.truth.image_error(x), 0.0)
        for k, (x, n) in enumerate(zip(points, counts, strict=True))
    ]
    return Trace(task, "m", list(points), rows, ENDED)


def pixel(image, x, y):
    return Image.Image.getpixel(image, (x, y))


@pytest.mark.parametrize("name", catalogue.FITTING)
def test_the_recommended_method_can_be_used(name):
    assert recommended(catalogue.fitting(name)).unusable(catalogue.fitting(name)) is None


def test_a_task_without_a_box_is_shown(monkeypatch):
    monkeypatch.setattr(catalogue, "fitting", lambda *_: replace(small.TASK, evaluations=20))
    ((found, _),) = traces([small.TASK.name], None, 0, 60.0, "fast", "auto")
    assert (found.method, found.outcome.status) == ("auto", "finished")


def test_a_trace_has_a_point_for_every_row():
    found = trace(small.TASK, small.HALVE, run=3)
    start = small.TASK.start(3)
    assert len(found.points) == len(found.records) > 4
    for k, (x, row) in enumerate(zip(found.points, found.records, strict=True)):
        torch.testing.assert_close(x, small.TARGET + 0.5**k * (start - small.TARGET))
        assert row.evaluations == 2 * k
    assert found.error == pytest.approx([0.25**k for k in range(len(found.points))], rel=1e-9)
    assert found.caption(1) == "2 evaluations, error 25 %"
    assert found.outcome.status == "finished"


def test_a_run_that_diverged_has_not_arrived():
    found = made([vector(0, 0), vector(1, 0)])
    found.records[:] = [replace(found.records[0], image_error=4.0), replace(found.records[1], image_error=None)]
    assert found.caption(0) == "0 evaluations, error 100 %"
    assert found.caption(1) == "2 evaluations, error not finite"


def test_a_trace_of_a_failure_has_the_start():
    found = trace(small.TASK, small.FAIL, run=0)
    assert (len(found.points), found.outcome.status) == (1, "failed")
    assert shown_rows(found, 10) == [0]


def test_shown_rows_are_at_equal_ratios_of_evaluations():
    points = [vector(float(k), 0.0) for k in range(1025)]
    rows = shown_rows(made(points, list(range(1025))), 11)
    assert rows == [0, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024]


def test_shown_rows_leave_out_what_did_not_move():
    points = [vector(0, 0), vector(0, 0), vector(1, 0), vector(1, 0), vector(2, 0), vector(2, 0)]
    assert shown_rows(made(points), 10) == [0, 2, 4, 5]


@pytest.mark.parametrize("count", [2, 3, 7])
def test_shown_rows_are_no_more_than_asked_for(count):
    rows = shown_rows(made([vector(float(k), 0.0) for k in range(50)]), count)
    assert (rows[0], rows[-1]) == (0, 49)
    assert len(rows) <= count
    assert rows == sorted(set(rows))


def test_tasks_look_like_their_pictures():
    seen = look(small.TASK, small.TASK.start(0))
    assert seen.picture is small.picture
    assert torch.equal(seen.target, small.picture(small.TARGET))
    assert look(replace(small.TASK, picture=None, n=3), torch.zeros(3)) is None


def bowl(at, bounds=None):
    return replace(small.TASK, loss=lambda x: (x - at).square().sum(1), picture=None, bounds=bounds)


def place(picture):
    """Column and row of the middle of the disc, in shares of the side."""
    rows, columns = ((picture[..., 0] - picture[..., 1]) > 0.5).double().nonzero(as_tuple=True)
    return float(columns.double().mean()) / (picture.shape[1] - 1), float(rows.double().mean()) / (len(picture) - 1)


def test_a_map_has_the_point_and_the_least_loss_where_they_are():
    task = bowl(vector(-1.0, 3.0), bounds=(vector(-4.0, -4.0), vector(4.0, 4.0)))
    seen = look(task, task.start(0))
    assert place(seen.picture(vector(2.0, -2.0))) == pytest.approx((0.75, 0.75), abs=0.01)  # right and below
    assert place(seen.target) == pytest.approx((3 / 8, 1 / 8), abs=0.02)
    ground = seen.picture(vector(4.0, -4.0))[..., 1]
    darkest = ground[ground > 0.2].min()  # beside the disc
    assert float(ground[15, 45]) == float(darkest)
    assert float(ground[-1, 0]) > float(ground[60, 0]) > float(ground[15, 45])


def test_a_map_without_bounds_reaches_beyond_the_start():
    task = quad.task()
    seen = look(task, task.start(0))
    assert place(seen.target) == pytest.approx((0.5, 0.5), abs=0.01)
    x, y = place(seen.picture(task.start(0)))
    assert 0.9 < max(x, 1 - y) < 0.98


def test_tiles_have_whole_pixels():
    picture = vector(*([0.0, 1.0, 0.5] * 2)).reshape(2, 3)
    image = tile(picture, 8)
    assert image.size == (12, 8)
    assert [pixel(image, 4 * k + i, j)[0] for k in range(3) for i, j in ((0, 0), (3, 7))] == [0, 0, 255, 255, 128, 128]
    assert tile(torch.zeros(100, 50, 3), 8).size == (50, 100)


def test_frames_show_the_point_beside_the_target():
    points = [small.TARGET + 3, small.TARGET]
    images = frames(made(points), Look(small.picture, small.picture(small.TARGET)), [0, 1], height=20)
    assert {image.size for image in images} == {(2 * 20 + 6, 20 + 36)}
    for image, x in zip(images, points, strict=True):
        for left, shown in ((0, x), (26, small.TARGET)):
            colors = [pixel(image, left + 5, 28)[0], pixel(image, left + 15, 28)[0]]
            assert colors == [round(255 * min(abs(float(one)) / 10, 1)) for one in shown]
    for band in ((0, 0, 46, 18), (0, 38, 46, 56)):
        assert images[0].crop(band).convert("L").getextrema()[0] < 128  # there is text


def test_several_animations_together():
    short = [captioned([Image.new("RGB", (40, 30), color)], "", "") for color in ("red", "blue")]
    long = [captioned([Image.new("RGB", (40, 30), color)], "", "") for color in ("lime", "white", "black")]
    found = together([short, long, short], across=2)
    corners = [tuple(pixel(frame, x, y) for x, y in ((20, 30), (72, 30), (20, 102))) for frame in found]
    red, blue, lime, white, black = (255, 0, 0), (0, 0, 255), (0, 255, 0), (255, 255, 255), (0, 0, 0)
    assert corners == [(red, lime, red), (blue, white, blue), (blue, black, blue)]


@pytest.mark.parametrize("webp", [True, False])
def test_animations_can_be_read_again(tmp_path, monkeypatch, webp):
    from PIL import features

    if not webp:
        monkeypatch.setattr(features, "check", lambda name: False)
    colors = [(250, 0, 0), (0, 250, 0), (0, 0, 250)]
    path = save([Image.new("RGB", (32, 32), color) for color in colors], tmp_path / "x")
    assert path.suffix == (".webp" if webp and features.check("webp") else ".gif")
    with Image.open(path) as image:
        shown = [pixel(frame.convert("RGB"), 16, 16) for frame in ImageSequence.Iterator(image)]
    assert len(shown) == 3
    for found, color in zip(shown, colors, strict=True):
        assert max(abs(a - b) for a, b in zip(found, color, strict=True)) < 12


def test_stills_are_finer_than_what_the_run_saw():
    asked = []

    def scene(setting):
        asked.append(setting)
        width, height = setting.film
        return lambda x: torch.full((len(x), height, width, 3), 0.25)

    task = rendered(
        name="grey",
        title="",
        parameters="",
        scene=scene,
        moving=scene,
        variant="scalar_rgb",
        setting=Setting((30, 20), 8, 2),
        needs="",
        solution=torch.zeros(1),
        start=lambda run: torch.ones(1),
        sigma=1.0,
        evaluations=10,
    )
    seen = finer(task, Look(task.picture.of, torch.zeros(20, 30, 3)))
    assert asked == [Setting((210, 140), 64, 2)]  # 7 x 20 is the first multiple beyond 128
    assert seen.picture(torch.ones(1)).shape == seen.target.shape == (140, 210, 3)
    other = Look(small.picture, torch.zeros(2, 2))
    assert finer(small.TASK, other) is other


def test_overviews_go_on_in_another_row(tmp_path):
    found = made([small.TARGET + 3, small.TARGET])
    seen = Look(small.picture, small.picture(small.TARGET))
    sizes = []
    for count in (5, 9):
        supplement_figures.overview([supplement_figures.Column.of(found, seen)] * count, tmp_path / "figure9.png")
        with Image.open(tmp_path / "figure9.png") as image:
            sizes.append(image.size)
    assert sizes[1] == (sizes[0][0], 2 * sizes[0][1])  # 5 across, and 5 + 4


def test_figure_of_the_caustic(tmp_path):
    task: Task = caustic.task()
    flat = torch.zeros(task.n).double()
    found = made([task.start(0), flat, 0.5 * task.start(0)], [0, 3, 9], task)
    supplement_figures.caustic(found, look(task, flat), replace(found, method="other"), tmp_path / "figure12.png")
    with Image.open(tmp_path / "figure12.png") as image:
        assert image.width > 2 * image.height


def test_figure_of_a_run_that_ended_before_its_first_report(tmp_path):
    task: Task = caustic.task()
    start, end = task.start(0), 0.5 * task.start(0)
    seen, ended = look(task, start), made([start], task=task)
    for other in (None, made([start, end], task=task)):
        supplement_figures.caustic(ended, seen, other, tmp_path / "figure12.png")
        with Image.open(tmp_path / "figure12.png") as image:
            assert image.width > 0


def test_the_surface_of_the_caustic():
    # B-splines sum to 1, and uniform ones of a linear sequence are linear.
    torch.testing.assert_close(
        supplement_figures._surface(torch.full((1024,), 3.0).double()), 3 * torch.ones(128, 128).double()
    )
    ramp = supplement_figures._surface(torch.arange(32.0).double().repeat(32))
    torch.testing.assert_close(ramp[5], torch.linspace(1, 30, 128).double())


def test_mirrors_from_outside():
    image = supplement_figures.mirrors_from_outside("scalar_rgb", film=(48, 36), spp=4)
    red = (image[..., 0] > 2 * image[..., 1]).nonzero()
    # The eye is up on the left, and the line leads from there to the bunny at the right.
    assert len(red) > 10
    assert float(red[:, 1].min()) < 12
    assert float(red[:, 1].max()) > 36


def test_command(tmp_path, capsys):
    (tmp_path / "cnn").mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "cnn" / "predictions.png")
    traces = gallery(tmp_path, tasks=("quad", "box2"), run=1, count=5)
    printed = capsys.readouterr().out
    assert [found.outcome.status for found in traces] == ["finished", "finished"]
    for found in traces:
        assert found.error[-1] <= 1e-3
        assert re.search(rf"{found.task.name} .* {found.records[-1].evaluations} ", printed)
    folder = tmp_path / "gallery"
    page = (folder / "index.html").read_text()
    linked = set(re.findall("src='([^']*)'", page))
    assert linked | {"index.html"} == {path.name for path in folder.iterdir()}
    assert {"figure9.png", "cnn.png"} < linked
    with Image.open(next(folder.glob("box2.*"))) as image:
        assert 1 < image.n_frames <= 5
    assert "QUAD: " in page
    assert "BOX2: " in page


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"tasks": ("box",)}, "tasks must be"), ({"count": 1}, "count must be at least 2"), ({"run": -1}, "run must be")],
)
def test_wrong_arguments(tmp_path, wrong, message):
    with pytest.raises(SystemExit, match=message):
        gallery(tmp_path, **wrong)


def test_nothing_to_show(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.studies.gallery.look", lambda task, start: None)
    with pytest.raises(SystemExit, match="no task"):
        gallery(tmp_path, tasks=("quad",))


def test_captions_are_in_a_font_that_is_there():
    assert animation._font().getlength("error") > 20
