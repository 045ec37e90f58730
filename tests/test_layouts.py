"""Cameras of other kinds: mosaics, sequences, band-pass sets; their measurements and estimates."""

import numpy as np
import pytest
import torch
from xarray import DataArray

from conftest import small_design
from squilla.calibration.calibrate import calibrate
from squilla.calibration.rehearsal import ideal_calibration, poster
from squilla.calibration.single_lens import demosaick, measure_mosaic, measure_sequence
from squilla.camera.design import CameraDesign, designs
from squilla.camera.twin import Camera
from squilla.errors import InputError
from squilla.reconstruction.models import load_model

TILE = np.array([[3, 1, 4], [0, 5, 2]])


def single(layout, shape, **filters) -> CameraDesign:
    """A single lens before a small part of a sensor."""
    tree = CameraDesign.load("mosaic-16").model_dump()
    tree["filters"] |= {"layout": layout, "shape": shape} | filters
    tree["sensor"] |= {"rows": 100, "columns": 100}
    tree["field"] |= {"size": 60}
    tree["band"] |= {"step": 10.0}
    return CameraDesign.model_validate(tree)


def coloured(design, size=110) -> DataArray:
    scene = poster(size, design.wavelength, seed=5)
    tint = 0.3 + 0.7 * np.exp(-((design.wavelength - 590) ** 2) / 2 / 60**2)
    return (scene * tint).astype(np.float32)


# --- designs ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", designs())
def test_every_design_that_ships_has_filters_for_all_places(name):
    camera = Camera(name)
    transmittance = camera.filters.transmittance(camera.design.wavelength)
    assert len(transmittance) == camera.design.channels
    assert 0 <= float(transmittance.min()) <= float(transmittance.max()) <= 1
    assert camera.design.field.size == 250


def test_published_numbers_of_filters():
    counts = {name: CameraDesign.load(name).channels for name in designs()}
    published = {"thesis": 36, "tombo": 7, "linear-variable": 66, "mosaic-16": 16}
    published |= {"mosaic-64": 64, "sequential-16": 16, "sequential-36": 36, "band-pass": 36}
    assert counts == published


@pytest.mark.parametrize(
    ("section", "changes", "says"),
    [
        ("filters", {"layout": "mosaic"}, "shape"),
        ("filters", {"shape": (4, 4)}, "shape"),
        ("filters", {"layout": "mosaic", "shape": (4, 4)}, "single lens"),
        ("filters", {"layout": "mosaic", "shape": (0, 4)}, "1 to 16"),
        ("filters", {"size": None, "gap": 0.9}, "size"),
        ("filters", {"distance": 2500.0}, "focal length"),
        ("walls", {"height": 2500.0}, "focal length"),
        ("walls", {"height": 1000.0, "thickness": 300.0}, "lenses free"),
    ],
)
def test_impossible_layouts_are_refused(section, changes, says):
    with pytest.raises(ValueError, match=says):
        small_design(**{section: changes})


# --- the twin -----------------------------------------------------------------------------------


def test_a_mosaic_is_the_sequence_seen_through_its_pixels():
    """Each pixel of a mosaic holds what its own filter alone, before the whole lens, would show."""
    mosaic = Camera(single("mosaic", (2, 3)))
    sequence = Camera(single("sequential", (2, 3)))
    scene = coloured(mosaic.design)
    every, one = sequence.rate(scene), mosaic.rate(scene)
    tile = mosaic.design.mosaic
    number = np.tile(tile, (50, 34))[:100, :100]
    picked = np.take_along_axis(every, number[None], 0)[0]
    np.testing.assert_allclose(one, picked, rtol=1e-5)
    light = np.linspace(1, 2, len(mosaic.design.wavelength))
    flats = np.take_along_axis(sequence.flat_rate(light), number[None], 0)[0]
    np.testing.assert_allclose(mosaic.flat_rate(light), flats, rtol=1e-6)


def test_a_sequence_divides_the_exposure():
    camera = Camera(single("sequential", (2, 2)))
    scene = coloured(camera.design)
    raws = list(camera.capture_sequence(scene, exposure=40.0))
    assert [raw.exposure for raw in raws] == [10.0] * 4
    seen = np.stack([raw.frame for raw in raws]) - camera.design.sensor.black_level
    expected = camera.rate(scene) * 10.0 / camera.design.sensor.gain
    np.testing.assert_allclose(seen.mean((1, 2)), expected.mean((1, 2)), rtol=0.02)


def test_a_moving_scene_is_seen_as_it_stands_at_each_exposure():
    camera = Camera(single("sequential", (1, 3)))
    scene = coloured(camera.design)
    moved = [scene.roll(x=step) for step in (0, 2, 4)]
    raws = camera.capture_sequence(iter(moved), exposure=300.0)
    for channel, raw in enumerate(raws):
        rate = camera.rate(moved[channel])[channel]
        seen = raw.frame - camera.design.sensor.black_level
        assert np.corrcoef(seen.ravel(), rate.ravel())[0, 1] > 0.99


def test_the_wrong_way_to_take_pictures_is_refused():
    sequence, mosaic = Camera(single("sequential", (2, 2))), Camera(single("mosaic", (2, 2)))
    scene = coloured(sequence.design)
    with pytest.raises(InputError, match="capture_sequence"):
        sequence.capture(scene, exposure=10.0)
    with pytest.raises(InputError, match=r"use Camera\.capture"):
        next(mosaic.capture_sequence(scene, exposure=10.0))


# --- demosaicking -------------------------------------------------------------------------------


def mosaicked(full, tile):
    height, width, _ = full.shape
    number = np.tile(tile, (height, width))[:height, :width]
    return np.take_along_axis(full, number[..., None], -1)[..., 0]


def test_a_scene_of_one_colour_is_exact(generator):
    levels = 0.1 + torch.rand(6, generator=generator).numpy()
    full = np.broadcast_to(levels, (40, 50, 6))
    for white in (np.ones(6), levels[::-1].copy()):
        np.testing.assert_allclose(demosaick(mosaicked(full, TILE), TILE, white), full, rtol=1e-5)


def test_a_grey_ramp_is_exact_inside():
    ramp = 1 + 0.01 * np.add.outer(np.arange(40), 2 * np.arange(50))
    white = np.linspace(0.5, 2, 6)
    full = ramp[..., None] * white
    found = demosaick(mosaicked(full, TILE), TILE, white)
    np.testing.assert_allclose(found[8:-8, 8:-8], full[8:-8, 8:-8], rtol=1e-5)


def bilinear(image, tile, channels):
    """What a plain interpolation of every filter's own pixels makes of it."""
    from scipy.ndimage import convolve

    number = np.tile(tile, image.shape)[: image.shape[0], : image.shape[1]]
    hats = [size - np.abs(np.arange(1 - size, size)) for size in tile.shape]
    kernel = np.outer(*hats).astype(float)
    known = np.stack([number == channel for channel in range(channels)], -1).astype(float)
    smooth = [
        [convolve(part[..., k], kernel, mode="constant") for k in range(channels)]
        for part in (known * image[..., None], known)
    ]
    return np.stack([a / b for a, b in zip(*smooth, strict=True)], -1)


@pytest.mark.parametrize("shape", [(2, 3), (4, 4), (8, 8)])
def test_detail_survives_better_than_in_bilinear_interpolation(shape):
    sequence = Camera(single("sequential", shape))
    mosaic = Camera(single("mosaic", shape))
    full = np.moveaxis(sequence.rate(coloured(sequence.design)), 0, -1)
    tile, white = mosaic.design.mosaic, sequence.sensitivity(0.0).sum((0, 2))
    image = mosaicked(full, tile)
    inner = (slice(20, -20), slice(20, -20))
    error, plain = (
        np.square(((found - full) / white)[inner]).mean()
        for found in (demosaick(image, tile, white), bilinear(image, tile, len(white)))
    )
    assert error < 0.5 * plain


def test_bad_pixels_do_not_spread(generator):
    full = np.broadcast_to(np.linspace(0.5, 1, 6), (40, 50, 6)).copy()
    image, bad = mosaicked(full, TILE).copy(), np.zeros((40, 50), bool)
    bad[20, 21] = bad[7, 30] = True
    image[bad] = 1e6
    np.testing.assert_allclose(demosaick(image, TILE, np.ones(6), bad), full, rtol=0.02)


# --- measurement and reconstruction -------------------------------------------------------------


def test_an_ideal_calibration_is_what_frames_teach(camera, calibration):
    ideal = ideal_calibration(camera)
    np.testing.assert_allclose(ideal.angle, calibration.angle)
    difference = calibration.sensitivity - ideal.sensitivity
    assert np.sqrt(np.mean(difference**2) / np.mean(ideal.sensitivity**2)) < 0.01
    np.testing.assert_allclose(ideal.lattice.centre, calibration.lattice.centre, atol=0.4)
    np.testing.assert_allclose(ideal.lattice.baseline, calibration.lattice.baseline, atol=0.01)


@pytest.mark.parametrize("layout", ["mosaic", "sequential"])
def test_measurements_explain_the_scene(layout):
    """Without noise to speak of, y = R x wherever the scene is smooth."""
    design = single(layout, (4, 4))
    tree = design.model_dump()
    tree["sensor"] |= {"bits": 16, "full_well": 1e10, "prnu": 0.01, "hot_pixels": 0.0}
    camera = Camera(CameraDesign.model_validate(tree))
    scene = coloured(design)
    scene.values[:] = scene.values.mean((0, 1))
    calibration = ideal_calibration(camera)
    if layout == "mosaic":
        raw = camera.capture(scene, exposure=1e6)
        measured = measure_mosaic(raw, calibration, design.mosaic)
    else:
        raws = camera.capture_sequence(scene, exposure=16e6)
        measured = measure_sequence(raws, calibration)
    x = torch.from_numpy(camera.truth(scene).cube.values)
    predicted = calibration.project(x, measured.angle)
    assert measured.y.shape == (60, 60, 16)
    assert float((measured.y - predicted).norm() / predicted.norm()) < 0.01
    cube = load_model("ridge", calibration).reconstruct(measured)
    assert float(np.sqrt(np.mean((cube.values - x.numpy()) ** 2))) < 0.1 * float(x.max())


def test_frames_that_do_not_fit_are_refused(calibration):
    camera = Camera(single("mosaic", (2, 2)))
    ideal = ideal_calibration(camera)
    raw = camera.capture(coloured(camera.design), snr=20.0)
    with pytest.raises(InputError, match="each of the 4 filters"):
        measure_mosaic(raw, ideal, TILE)
    with pytest.raises(InputError, match="single lens"):
        measure_mosaic(raw, calibration, TILE)
    with pytest.raises(InputError, match="4 frames"):
        measure_sequence([raw], ideal)


def test_calibrate_says_that_it_knows_arrays_only():
    design = single("mosaic", (2, 2))
    with pytest.raises(InputError, match="lens array"):
        calibrate(design, dark=[], flat=[], sweep=[])
