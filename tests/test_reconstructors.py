"""What every reconstructor must do, and the way through files and whole measurements."""

from importlib.resources import files

import numpy as np
import pytest
import torch
from scipy.io import loadmat

from random_camera import smooth_camera
from squilla import InputError
from squilla.calibration.alignment import Measurement
from squilla.calibration.calibration import Calibration
from squilla.priors import broad_spectra
from squilla.reconstruction.linear import Ridge
from squilla.reconstruction.models import MODELS, load_model, model_class, models
from squilla.reconstruction.reconstructor import consistent_scale
from squilla.reconstruction.weights import fingerprint

CAMERA = smooth_camera(0, filters=12, bands=48, angles=3)
NETWORKS = [name for name in MODELS if model_class(name).trained]


def untrained(name, camera=CAMERA):
    if name == "twist":  # to the default tolerance it would take the time of all others together
        return model_class(name)(camera, tolerance=0.1)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return model_class(name)(camera).eval()


@pytest.fixture(scope="module", params=list(MODELS))
def model(request):
    return untrained(request.param)


@pytest.fixture(scope="module", params=[name for name in MODELS if name not in NETWORKS])
def solver(request):
    return untrained(request.param)


@pytest.fixture(scope="module")
def spectra():
    return broad_spectra(24, CAMERA.wavelength, generator=torch.Generator().manual_seed(3))


@pytest.fixture(scope="module")
def angle():
    return 0.15 * torch.rand(24, generator=torch.Generator().manual_seed(4))


@pytest.fixture(scope="module")
def y(spectra, angle):
    noise = torch.randn(24, 12, generator=torch.Generator().manual_seed(5))
    return CAMERA.project(spectra, angle) * (1 + 0.05 * noise)


# --- properties of every reconstructor ------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("pixels", [(), (1,), (24,), (4, 6), (2, 3, 4), (0,)])
def test_shape_type_and_sign(model, y, pixels):
    count = int(np.prod(pixels))
    x = model(y[:count].reshape(*pixels, 12))
    assert x.shape == (*pixels, 48)
    assert x.dtype == torch.float32
    assert (x >= 0).all()


@torch.no_grad()
@pytest.mark.parametrize("name", ["ridge", *NETWORKS])
def test_everything_is_made_on_the_device_of_the_model(name, y):
    """On the meta device any tensor that was made elsewhere is an error."""
    away = untrained(name).to("meta")
    x = away(y.to("meta"))
    assert (x.device.type, x.shape) == ("meta", (24, 48))


@torch.no_grad()
def test_double_precision_and_numpy_are_welcome(model, y):
    torch.testing.assert_close(model(y.double()), model(y))
    torch.testing.assert_close(model(y.numpy()), model(y))


@torch.no_grad()
def test_a_batch_is_the_loop_over_its_pixels(model, y, angle):
    together = model(y[:6], angle[:6])
    alone = torch.stack([model(y[i], angle[i]) for i in range(6)])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_pieces_make_no_difference(model, y, angle, monkeypatch):
    whole = model(y, angle)
    monkeypatch.setattr(type(model), "piece", 7)
    torch.testing.assert_close(model(y, angle), whole, rtol=1e-4, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("scale", ["consistent", "maximum"])
@pytest.mark.parametrize("factor", [2.0, 4096.0, 1e-6])
def test_twice_the_light_is_twice_the_spectrum(model, y, angle, scale, factor):
    x = model(y, angle, scale=scale)
    torch.testing.assert_close(model(factor * y, angle, scale=scale), factor * x, rtol=2e-3,
                               atol=factor * 2e-3 * float(x.max()))  # fmt: skip


@torch.no_grad()
def test_the_same_input_gives_the_same_bits(model, y, angle):
    assert torch.equal(model(y, angle), model(y, angle))


@torch.no_grad()
def test_one_angle_serves_all_pixels(model, y):
    each = model(y, torch.full((24,), 0.1))
    torch.testing.assert_close(model(y, 0.1), each)


@torch.no_grad()
def test_angles_do_nothing_without_a_sensitivity_that_knows_them(model, y, angle):
    flat = Calibration.from_sensitivity(CAMERA.sensitivity[0], CAMERA.wavelength)
    plain = untrained(model.name, flat)
    assert torch.equal(plain(y, angle), plain(y))


@torch.no_grad()
def test_broken_pixels_become_nan_and_dark_ones_zero(model, y):
    y = y.clone()
    clean = model(y)
    y[1, 3], y[2, 0], y[3] = torch.nan, torch.inf, 0
    x = model(y)
    assert x[[1, 2]].isnan().all()
    assert (x[3] == 0).all()
    torch.testing.assert_close(x[4:], clean[4:], rtol=1e-4, atol=1e-5)


def test_wrong_shapes_are_refused(model, y, angle):
    with pytest.raises(InputError, match="12 channels"):
        model(y[:, :11])
    with pytest.raises(InputError, match="field angles"):
        model(y, angle[:5])
    with pytest.raises(InputError, match="NaN"):
        model(y, torch.full((24,), torch.nan))
    with pytest.raises(InputError, match="no scale"):
        model(y, scale="thesis")


@torch.no_grad()
def test_solvers_explain_the_measurement(solver, spectra):
    """Without noise, what the estimate would measure is nearly what was measured."""
    y = CAMERA.project(spectra)
    rest = CAMERA.project(solver(y, snr=35.0)) - y
    assert rest.norm() < 0.05 * y.norm()


def test_networks_see_what_the_mean_sensitivity_would_measure():
    """At the ends of the field hardly more than half of the tilt's change is left."""
    camera = smooth_camera(0, filters=36, bands=48, angles=3)
    spectra = broad_spectra(200, camera.wavelength, generator=torch.Generator().manual_seed(3))
    network, mean = untrained("mlp", camera), camera.project(spectra)
    for end in camera.angle[[0, -1]]:
        angle = torch.full((200,), float(end))
        y = camera.project(spectra, angle)
        left = network.levelled(y, angle) - mean
        assert left.norm() < 0.6 * (y - mean).norm()
    assert network.levelled(mean, None) is mean


# --- the scale of a network -----------------------------------------------------------------


def test_consistent_scale_is_the_least_squares_factor(spectra, y, angle):
    factor = consistent_scale(y, spectra, CAMERA, angle)
    expected = CAMERA.project(spectra, angle)
    for pixel in range(len(y)):
        best = np.linalg.lstsq(expected[pixel, :, None].numpy(), y[pixel].numpy(), rcond=None)
        np.testing.assert_allclose(factor[pixel, 0], best[0][0], rtol=1e-4)


def test_rules_of_scale(y):
    model = model_class("respecnn")(CAMERA)
    with torch.no_grad():
        thesis = model(y, scale="maximum")
        own = model(y)
        shape = model.estimate(y / y.amax(-1, keepdim=True), None)
    torch.testing.assert_close(thesis, shape * y.amax(-1, keepdim=True))
    again = consistent_scale(y, own, CAMERA)
    torch.testing.assert_close(again, torch.ones_like(again))


# --- whole measurements ---------------------------------------------------------------------


def measurement(y, angle, valid=None, snr=25.0):
    valid = torch.ones(4, 6, 12, dtype=torch.bool) if valid is None else valid
    return Measurement(
        y.reshape(4, 6, 12),
        valid,
        angle.reshape(4, 6),
        torch.zeros(4, 6),
        torch.full((4, 6), snr),
        {"distance": 300.0},
    )


def test_a_cube_carries_wavelengths_and_origin(model, y, angle):
    cube = model.reconstruct(measurement(y, angle))
    assert cube.dims == ("y", "x", "wavelength")
    assert cube.shape == (4, 6, 48)
    assert cube.dtype == np.float32
    np.testing.assert_array_equal(cube.wavelength, CAMERA.wavelength)
    assert cube.wavelength.attrs["standard_name"] == "radiation_wavelength"
    assert cube.wavelength.attrs["units"] == "nm"
    assert cube.attrs["model"] == model.name
    assert cube.attrs["calibration"] == fingerprint(CAMERA)
    assert cube.attrs["measurement_distance"] == 300
    with torch.no_grad():
        expected = model(y.reshape(4, 6, 12), angle.reshape(4, 6), 25.0)
    torch.testing.assert_close(torch.from_numpy(cube.values), expected)


def test_a_cube_survives_netcdf(tmp_path, y, angle):
    cube = load_model("ridge", CAMERA).reconstruct(measurement(y, angle))
    cube.to_netcdf(tmp_path / "cube.nc", engine="h5netcdf")
    import xarray

    with xarray.open_dataarray(tmp_path / "cube.nc", engine="h5netcdf") as again:
        xarray.testing.assert_identical(again.load(), cube)


def test_invalid_channels_hardly_change_the_spectrum(solver, spectra, angle):
    valid = torch.rand(4, 6, 12, generator=torch.Generator().manual_seed(6)) < 0.9
    y = CAMERA.project(spectra, angle)
    whole = solver.reconstruct(measurement(y, angle)).values
    saturated = torch.where(valid, y.reshape(4, 6, 12), 1e4)
    part = solver.reconstruct(measurement(saturated, angle, valid)).values
    kept = valid.all(-1).numpy()
    np.testing.assert_allclose(part[kept], whole[kept], rtol=1e-4, atol=1e-5)
    assert np.square(part - whole).mean() < 0.2 * np.square(whole).mean()


def test_pixels_without_enough_channels_become_nan(model, y, angle):
    valid = torch.ones(4, 6, 12, dtype=torch.bool)
    valid[2, 3, :7] = False
    cube = model.reconstruct(measurement(y, angle, valid)).values
    assert np.isnan(cube[2, 3]).all()
    assert np.isfinite(np.delete(cube.reshape(24, 48), 2 * 6 + 3, axis=0)).all()


def test_the_measured_noise_sets_the_linear_estimator(y, angle):
    generous = Ridge(CAMERA).reconstruct(measurement(y, angle, snr=40)).values
    own = Ridge(CAMERA)(y, angle, 40.0).reshape(4, 6, 48)
    torch.testing.assert_close(torch.from_numpy(generous), own)


def test_every_pixel_is_treated_by_its_own_noise(solver, y, angle):
    """A batch of mixed noise gives what each pixel gives alone."""
    y, angle, snr = y[:4], angle[:4], torch.linspace(5, 40, 4)
    alone = [solver(y[n : n + 1], angle[n : n + 1], float(snr[n])) for n in range(4)]
    torch.testing.assert_close(solver(y, angle, snr), torch.cat(alone), rtol=1e-3, atol=1e-4)


# --- names and files ------------------------------------------------------------------------


def test_every_model_has_a_line():
    assert set(models()) == set(MODELS)
    assert all(models().values())


@pytest.mark.parametrize("mosaic", ["4x4", "5x5"])
@pytest.mark.parametrize("name", [name for name in MODELS if name not in NETWORKS])
def test_solvers_serve_cameras_of_other_bands(name, mosaic):
    """Mosaic sensors of 400-1000 nm, measured; the tables of natural spectra end before."""
    path = files("squilla") / "data" / "responses" / f"spectral_responses_{mosaic}.mat"
    response = loadmat(str(path))["SpectralProfiles"][:, ::10]
    camera = Calibration.from_sensitivity(response, np.arange(400.0, 1001, 10))
    y = torch.rand(2, 2, camera.filters, generator=torch.Generator().manual_seed(0)) + 0.5
    valid = torch.ones(y.shape, dtype=torch.bool)
    valid[0, 0, 3] = False
    one = Measurement(y, valid, torch.zeros(2, 2), torch.zeros(2, 2))
    cube = untrained(name, camera).reconstruct(one)
    assert cube.shape == (2, 2, 61)
    assert np.isfinite(cube).all()


def test_a_picture_of_any_camera_becomes_a_measurement():
    """Missing values are left out; what is no picture is refused."""
    y = torch.rand(5, 6, CAMERA.filters, generator=torch.Generator().manual_seed(0)) + 0.5
    y[2, 3, 1] = torch.nan
    taken = Measurement.of(y.numpy(), snr=30)
    assert taken.valid.sum() == y.numel() - 1
    assert not taken.valid[2, 3, 1]
    assert np.isfinite(load_model("ridge", CAMERA).reconstruct(taken)).all()
    with pytest.raises(InputError, match="height, width, channels"):
        Measurement.of(y[0])


@pytest.mark.parametrize("name", NETWORKS)
def test_a_file_gives_the_same_network(name, tmp_path, y):
    model = model_class(name)(CAMERA).eval()
    model.provenance = {"noise": "15-20 dB", "seed": 3}
    model.save(tmp_path / "model.safetensors")
    again = load_model(tmp_path / "model.safetensors", CAMERA)
    assert again.provenance == model.provenance
    with torch.no_grad():
        assert torch.equal(model(y), again(y))
    assert [path.name for path in tmp_path.iterdir()] == ["model.safetensors"]


@pytest.fixture
def saved(tmp_path):
    model_class("mlp")(CAMERA).save(tmp_path / "model.safetensors")
    return tmp_path / "model.safetensors"


def test_half_the_size(saved, tmp_path, y):
    model = load_model(saved, CAMERA)
    model.save(tmp_path / "half.safetensors", half=True)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.51 * saved.stat().st_size
    with torch.no_grad():
        whole = model(y)
        half = load_model(tmp_path / "half.safetensors", CAMERA)(y)
    assert (half - whole).norm() < 5e-3 * whole.norm()


def changed(factor, deviation, seed=0):
    random = np.random.default_rng(seed)
    sensitivity = factor * CAMERA.sensitivity
    noise = random.normal(size=sensitivity.shape[1:])
    scale = deviation * np.linalg.norm(sensitivity.mean(0)) / np.linalg.norm(noise)
    return Calibration.from_sensitivity(
        sensitivity + scale * noise, CAMERA.wavelength, CAMERA.angle
    )


def test_weights_follow_a_camera_measured_again(saved):
    load_model(saved, changed(3.0, 0.04))


def test_weights_refuse_another_camera(saved):
    with pytest.raises(InputError, match=r"differs .* by 8\.\d%.*Train"):
        load_model(saved, changed(3.0, 0.085))
    with pytest.raises(InputError, match="12 channels and 48 bands"):
        load_model(saved, smooth_camera(filters=12, bands=50))
    shifted = Calibration.from_sensitivity(CAMERA.sensitivity[0], CAMERA.wavelength + 1)
    with pytest.raises(InputError, match="501-751 nm"):
        load_model(saved, shifted)


def test_damaged_and_foreign_files_are_refused(saved, tmp_path):
    from safetensors import safe_open
    from safetensors.torch import save_file

    content = saved.read_bytes()
    broken = tmp_path / "broken.safetensors"
    for damaged in (b"", b"not a model", content[:100], content[: len(content) // 2], content[9:],
                    b"\xff" * 8 + content[8:]):  # fmt: skip
        broken.write_bytes(damaged)
        with pytest.raises(InputError, match="not a whole model file"):
            load_model(broken, CAMERA)
    save_file({"weights.a": torch.zeros(3)}, broken)
    with pytest.raises(InputError, match="not a model of squilla"):
        load_model(broken, CAMERA)
    broken.write_bytes(content.replace(b"layers.0.weight", b"layers.0.wrongs"))
    with pytest.raises(InputError, match="checksum"):
        load_model(broken, CAMERA)
    with safe_open(saved, "pt") as file:
        names = list(file.keys())
        metadata = {key: text for key, text in file.metadata().items() if key != "checksum"}
        tensors = {name.replace("weight", "wrongs"): file.get_tensor(name) for name in names}
    save_file(tensors, broken, metadata)
    with pytest.raises(InputError, match="other weights"):
        load_model(broken, CAMERA)
    broken.write_bytes(content.replace(b"500,500", b"250,999", 1))
    with pytest.raises(InputError):
        load_model(broken, CAMERA)


def test_weights_that_are_not_finite_are_refused(tmp_path):
    model = model_class("mlp")(CAMERA)
    with torch.no_grad():
        model.layers[0].weight[0, 0] = torch.nan
    model.save(tmp_path / "model.safetensors")
    with pytest.raises(InputError, match="not finite"):
        load_model(tmp_path / "model.safetensors", CAMERA)


def test_unknown_names_are_answered_with_the_known_ones(tmp_path):
    for name in ("resnet", tmp_path / "missing.safetensors", tmp_path):
        with pytest.raises(InputError, match="ridge, nnls, sparse"):
            load_model(name, CAMERA)
    with pytest.raises(InputError, match="load_calibration"):
        load_model("ridge", None)
    with pytest.raises(InputError, match="train it"):
        load_model("unet", CAMERA)


def test_solvers_have_nothing_to_save(tmp_path):
    with pytest.raises(InputError, match="no weights"):
        load_model("ridge", CAMERA).save(tmp_path / "ridge.safetensors")


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        model_class("mlp")(CAMERA).save(tmp_path / "nowhere" / "model.safetensors")


def test_an_interrupted_save_leaves_the_old_file(saved, monkeypatch):
    before = saved.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(InputError, match="disk full"):
        model_class("mlp")(CAMERA).save(saved)
    assert saved.read_bytes() == before
    assert len(list(saved.parent.iterdir())) == 1


def test_fingerprints_tell_cameras_apart():
    again = smooth_camera(0, filters=12, bands=48, angles=3)
    assert fingerprint(again) == fingerprint(CAMERA)
    assert fingerprint(changed(1.001, 0)) != fingerprint(CAMERA)


@pytest.mark.parametrize("name", ["ridge", "compound"])
def test_only_measurements_are_reconstructed(name):
    with pytest.raises(InputError, match="Only a measurement is reconstructed"):
        load_model(name, CAMERA).reconstruct(np.ones((4, 4, CAMERA.filters)))
