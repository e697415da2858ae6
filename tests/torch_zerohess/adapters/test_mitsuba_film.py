"""Films of another size: the field of view is that of the same scene described with such a film."""

import math

import numpy as np
import pytest
import torch
from small_scenes import VARIANTS, lamp, screen

from torch_zerohess.adapters.mitsuba import MitsubaScene, Value
from torch_zerohess.adapters.mitsuba_film import x_fov

FILMS = [(96, 48), (48, 96), (64, 64), (30, 20)]
AXES = [{"fov_axis": axis, "fov": 40.0} for axis in ("x", "y", "diagonal", "smaller", "larger")]
AXES += [{"fov": 40.0}, {"focal_length": "50mm"}]


def described(mi, film, **sensor):
    """A screen of 2x2 colours seen by a sensor of its own."""
    scene = screen(mi)
    view = scene["sensor"]["to_world"]
    size = {"type": "hdrfilm", "width": film[0], "height": film[1], "rfilter": {"type": "box"}}
    scene["sensor"] = {"type": "perspective", "to_world": view, "film": size, **sensor}
    return scene


def loaded(description, film=None, variant="scalar_rgb"):
    parameters = [Value("screen.emitter.radiance.data")]
    return MitsubaScene(description, parameters, film=film, spp=1, variant=variant, threads=1)


def angle(scene, name="sensor") -> float:
    return float(np.array(scene.values[f"{name}.x_fov"]).reshape(-1)[0])


@pytest.fixture(autouse=True)
def all_values(monkeypatch):
    """Scenes keep the fields of view among their values."""
    import mitsuba

    monkeypatch.setattr(mitsuba.SceneParameters, "keep", lambda *_: None)


@pytest.mark.parametrize("sensor", AXES, ids=str)
def test_a_film_of_another_shape_has_the_field_of_view_that_was_described(sensor) -> None:
    for before in ((40, 40), (60, 40)):
        for film in FILMS:
            changed = loaded(lambda mi, size=before: described(mi, size, **sensor), film)
            truth = loaded(lambda mi, size=film: described(mi, size, **sensor))
            assert angle(changed) == pytest.approx(angle(truth), rel=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_its_picture_is_that_of_a_scene_described_with_it(variant) -> None:
    """But for pixels at the borders of the colours."""
    x = torch.arange(12.0)[None]
    one = loaded(lambda mi: described(mi, (40, 40), fov=40.0, fov_axis="y"), (96, 48), variant)(x)
    other = loaded(lambda mi: described(mi, (96, 48), fov=40.0, fov_axis="y"), None, variant)(x)
    assert one.shape == other.shape == (1, 48, 96, 3)
    assert float((one != other).any(-1).float().mean()) < 0.005


def test_the_field_of_view_along_y_in_closed_form() -> None:
    truth = 2 * math.degrees(math.atan(2 * math.tan(math.radians(20))))
    assert x_fov(40.0, "y", (400, 400), (96, 48)) == pytest.approx(truth, rel=1e-12)
    assert x_fov(40.0, "x", (400, 400), (96, 48)) == pytest.approx(40.0, rel=1e-12)


@pytest.mark.parametrize("film", [(np.int64(8), np.int32(6)), np.array([8, 6]), torch.tensor([8, 6]), [8, 6]], ids=repr)
def test_a_film_is_any_two_integers(film) -> None:
    scene = MitsubaScene(
        lamp, [Value("lamp.emitter.radiance.value")], film=film, spp=1, variant="scalar_rgb", threads=1
    )
    assert scene(torch.ones(1, 3)).shape == (1, 6, 8, 3)


XML = """<scene version="3.0.0">
<default name="axis" value="y"/>
<sensor type="perspective" {name}><float name="fov" value="40"/><string name="fov_axis" value="$axis"/>
<film type="hdrfilm"><integer name="width" value="40"/><integer name="height" value="40"/></film></sensor>
<emitter type="constant" id="sky"/></scene>"""


@pytest.mark.parametrize("name", ["", 'id="eye"'])
@pytest.mark.parametrize("old", [False, True])
def test_a_file_of_any_version(tmp_path, name, old) -> None:
    path, text = tmp_path / "scene.xml", XML.format(name=name)
    path.write_text(text.replace("3.0.0", "0.5.0").replace("fov_axis", "fovAxis") if old else text)
    scene = MitsubaScene(path, [Value("sky.radiance.value")], film=(96, 48), depth=2, variant="scalar_rgb", threads=1)
    (found,) = (key.removesuffix(".x_fov") for key in scene.values.keys() if key.endswith(".x_fov"))  # noqa: SIM118
    assert angle(scene, found) == pytest.approx(x_fov(40.0, "y", (40, 40), (96, 48)), rel=1e-5)


def test_a_sensor_that_was_loaded_before_keeps_its_field_of_view_along_x() -> None:
    def whole(mi):
        scene = described(mi, (40, 40), fov=40.0, fov_axis="y")
        return scene | {"sensor": mi.load_dict(scene["sensor"])}

    assert angle(loaded(whole, (96, 48))) == pytest.approx(40.0, rel=1e-5)


def test_a_crop_window_is_refused() -> None:
    def cropped(mi):
        scene = lamp(mi)
        scene["sensor"]["film"] |= {"crop_width": 2, "crop_height": 1, "crop_offset_x": 1, "crop_offset_y": 3}
        return scene

    parameters = [Value("lamp.emitter.radiance.value")]
    settings = {"spp": 1, "variant": "scalar_rgb", "threads": 1}
    assert MitsubaScene(cropped, parameters, **settings)(torch.ones(1, 3)).shape == (1, 1, 2, 3)
    message = r"crop window, got \(8, 6\): sensor.film shows \(2, 1\) pixels from \(1, 3\) of \(4, 4\)"
    with pytest.raises(ValueError, match=message):
        MitsubaScene(cropped, parameters, film=(8, 6), **settings)
