"""Scenes by name and from files fill the camera's field on the camera's wavelengths."""

import numpy as np
import pytest

import squilla
from squilla.camera.scenes import SCENES
from squilla.camera.solid import solid_scene
from squilla.errors import InputError
from squilla.files.cube import labelled
from squilla.spectra import grid

WAVELENGTH = grid(520, 700, 20)


@pytest.mark.parametrize("name", SCENES)
def test_scenes_that_ship(name):
    scene = squilla.load_scene(name, WAVELENGTH, 48)
    assert scene.dims == ("y", "x", "wavelength")
    assert scene.shape == (48, 48, len(WAVELENGTH))
    np.testing.assert_array_equal(scene["wavelength"], WAVELENGTH)
    assert scene.values.min() >= 0
    assert 0.5 < scene.values.max() < 1.5


def test_the_middle_of_a_file_is_taken(tmp_path):
    """A step from left to right stays in the middle; its spectrum, a straight line, stays one."""
    picture = np.where(np.arange(90) < 45, 1.0, 3.0) * np.ones((60, 1))
    values = picture[..., None] * np.linspace(1, 2, 251)
    squilla.save(labelled(values.astype(np.float32), grid()), tmp_path / "step.nc")
    scene = squilla.load_scene(tmp_path / "step.nc", WAVELENGTH, 30).values
    expected = np.interp(WAVELENGTH, grid(), np.linspace(1, 2, 251))
    left, right = scene[15, 5], scene[15, 25]
    np.testing.assert_allclose(left / left[0], expected / expected[0], rtol=1e-4)
    np.testing.assert_allclose(right, 3 * left, rtol=1e-4)
    np.testing.assert_allclose(scene[:, :12], np.broadcast_to(left, (30, 12, 10)), rtol=1e-3)
    assert np.percentile(scene, 99.9) == pytest.approx(1, rel=1e-4)


def test_scenes_that_do_not_cover_the_band():
    with pytest.raises(InputError, match="extrapolated"):
        squilla.load_scene("chart", grid(400, 700, 20))
    with pytest.raises(InputError, match="no file"):
        squilla.load_scene("moon", WAVELENGTH)


@pytest.mark.parametrize("scene", [squilla.load_scene, solid_scene])
def test_a_light_that_is_not_there_is_answered_with_those_like_it(scene):
    given = ("chart",) if scene is squilla.load_scene else ()
    with pytest.raises(InputError, match=r"'LED-B33' among 629; the nearest are LED-B3,"):
        scene(*given, WAVELENGTH, 48, light="LED-B33")
