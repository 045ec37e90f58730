"""Engines give what PyTorch gives, and parts of a reconstruction are parts of the whole."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch

from random_camera import smooth_camera
from squilla.calibration.alignment import Measurement
from squilla.errors import InputError
from squilla.priors import natural_spectra
from squilla.reconstruction import compiled, engine, evidence
from squilla.reconstruction.models import load_model, model_class
from squilla.reconstruction.posteriors import CompiledCamera
from squilla.training.noise import add_noise

CAMERA = smooth_camera(0, filters=20, bands=126)
TILTED = smooth_camera(0, filters=20, bands=126, angles=5)


def needs(*packages):
    missing = [package for package in packages if find_spec(package) is None]
    return pytest.mark.skipif(
        bool(missing), reason=f"needs {missing}: pip install -e '.[engine]', then run again"
    )


ENGINES = [
    pytest.param("openvino", 1e-5, marks=needs("openvino")),
    pytest.param("openvino-bf16", 0.03, marks=needs("openvino")),
    pytest.param("onnxruntime", 1e-5, marks=needs("onnxruntime", "onnx", "onnxscript")),
]


def patches(camera, rows=37, columns=50, snr=25.0):
    """Return a measurement of four natural spectra with one dark and one NaN pixel."""
    generator = torch.Generator().manual_seed(3)
    spectra = natural_spectra(4, camera.wavelength, generator=generator)
    row, column = torch.arange(rows) >= 20, torch.arange(columns) >= 30
    angle = torch.linspace(0, float(camera.angle[-1]), columns).expand(rows, -1).contiguous()
    truth = spectra[2 * row[:, None].long() + column.long()]
    y = add_noise(camera.project(truth, angle if len(camera.angle) > 1 else None), snr, generator)
    y[3, 4] = 0
    y[30, 7] = torch.nan
    valid = torch.ones(y.shape, dtype=torch.bool)
    return Measurement(y, valid, angle, torch.zeros_like(angle), torch.full_like(angle, snr))


# --- compiled loops -----------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [CAMERA, TILTED], ids=["one angle", "by angle"])
@pytest.mark.parametrize("threads", [1, 3])
def test_compiled_loops_are_the_tensors_they_stand_for(camera, threads):
    model = load_model("compound", camera)
    measurement = patches(camera)
    y = torch.where(measurement.y.isfinite(), measurement.y, 0)
    height, width = 37, 50
    ratio = torch.full((height, width), 10**-2.0)
    ratio[3, 4] = ratio[30, 7] = torch.inf
    zone = None
    if len(camera.angle) > 1:
        zone = (torch.arange(width) * 8 // width).expand(height, -1).contiguous()
    with torch.inference_mode():
        front = model._camera(None, zone is not None)
        factor = evidence.noise_factor(y[None], ratio[None], front)
        padded = torch.nn.functional.pad(y[None], (0, 0, 0, 14, 0, 11))
        noise = torch.nn.functional.pad(ratio[None] * factor, (0, 14, 0, 11), value=torch.inf)
        places = None if zone is None else torch.nn.functional.pad(zone[None], (0, 14, 0, 11))
        expected = evidence.gather_evidence(padded, noise, front, evidence.LEVELS, places)
    matrices = CompiledCamera(front)
    own = compiled.noise_factor(y.numpy(), ratio.numpy(), matrices, threads)
    assert own == pytest.approx(float(factor), rel=1e-4)
    place = None if zone is None else zone.numpy()
    seen = y.numpy(), ratio.numpy()
    found = compiled.gather_evidence(*seen, own, matrices, place, threads, interval=True)
    for name in ("coefficients", "variance"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=2e-3, atol=2e-3
        )
    for name in ("kin", "alone", "own_noise"):
        for one, other in zip(getattr(found, name), getattr(expected, name), strict=True):
            torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-3)
    for one, other, alone in zip(found.own, expected.own, expected.alone, strict=True):
        heard = torch.sigmoid(alone) > 1.01 * evidence.UNHEARD  # others are not worked out
        assert heard.any()
        torch.testing.assert_close(one[heard], other[heard], rtol=2e-3, atol=2e-3)
    for part in ("amplitude", "variance"):
        one, other = getattr(found.bright, part), getattr(expected.bright, part)
        torch.testing.assert_close(one, other, rtol=2e-3, atol=1e-5)
    for name in ("pixels", "cells", "spectral"):
        for part in ("shape", "noise", "amplitude"):
            one, other = (getattr(getattr(each, name), part) for each in (found, expected))
            torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("camera", [CAMERA, TILTED], ids=["one angle", "by angle"])
def test_a_picture_is_the_same_with_and_without_gradients(camera):
    """Gradients need tensors; without them the loops do the work."""
    model = load_model("compound", camera)
    measurement = patches(camera)
    y = measurement.y.clone().requires_grad_()
    slow, wide = model.with_interval(y, measurement.angle, measurement.snr)
    fast, width = model.with_interval(measurement.y, measurement.angle, measurement.snr)
    torch.testing.assert_close(fast, slow.detach(), rtol=1e-3, atol=1e-4, equal_nan=True)
    torch.testing.assert_close(width, wide.detach(), rtol=5e-3, atol=1e-4, equal_nan=True)
    alone = model(measurement.y, measurement.angle, measurement.snr)
    torch.testing.assert_close(alone, fast, rtol=1e-4, atol=1e-5, equal_nan=True)


# --- engines ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "most"), ENGINES)
@pytest.mark.parametrize("network", ["mlp", "respecnn"])
def test_every_engine_gives_what_torch_gives(network, name, most):
    torch.manual_seed(0)
    model = model_class(network)(CAMERA).eval()
    measurement = patches(CAMERA)
    expected = model.reconstruct(measurement).values
    assert model.with_engine(name) is model
    found = model.reconstruct(measurement)
    known = np.isfinite(expected)
    assert (np.isfinite(found.values) == known).all()
    assert engine.error(found.values[known], expected[known]) < most
    assert found.attrs["model_engine"] == name
    assert found.attrs["model_engine_error"] < most
    again = model.with_engine("torch").reconstruct(measurement).values
    np.testing.assert_array_equal(again[known], expected[known])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU; run there")
@pytest.mark.parametrize(("name", "most"), [("cuda", 1e-4), ("cuda-bf16", 0.03)])
def test_a_recorded_graph_gives_what_it_was_recorded_from(name, most):
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(20, 64), torch.nn.ReLU(), torch.nn.Linear(64, 8))
    run = engine.compile_network(network, name)
    for pixels in (100, 3, 100):
        inputs = np.random.default_rng(pixels).normal(size=(pixels, 20)).astype(np.float32)
        found = run(inputs)
        with torch.inference_mode():
            expected = network(torch.from_numpy(inputs).cuda()).cpu().numpy()
        assert engine.error(found, expected) < most


@needs("openvino")
def test_openvino_computes_in_float32_unless_told():
    """By itself it would take bfloat16, an error of 1e-3 and more, where the processor has it."""
    network = torch.nn.Sequential(torch.nn.Linear(64, 64), torch.nn.ReLU(), torch.nn.Linear(64, 8))
    inputs = np.random.default_rng(0).normal(size=(500, 64)).astype(np.float32)
    with torch.inference_mode():
        reference = network.double()(torch.from_numpy(inputs).double()).numpy()
    found = engine.compile_network(network.float(), "openvino")(inputs)
    assert engine.error(found, reference) < 1e-6


@needs("onnxruntime", "onnx", "onnxscript")
@pytest.mark.parametrize("network", ["mlp", "respecnn"])
def test_an_exported_network_runs_elsewhere_for_any_number_of_pixels(tmp_path, network):
    import onnxruntime

    model = model_class(network)(CAMERA).eval()
    model.export(tmp_path / "model.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "model.onnx")
    for pixels in (1, 7, 300):
        y = torch.rand(pixels, 20)
        with torch.inference_mode():
            expected = model.estimate(y).numpy()
        found = session.run(None, {"measurement": y.numpy()})[0]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@needs("onnxruntime", "onnx", "onnxscript")
def test_export_by_command(tmp_path):
    import onnxruntime
    from typer.testing import CliRunner

    from squilla.calibration.store import save_calibration
    from squilla.cli.app import app

    save_calibration(CAMERA, tmp_path / "camera.nc")
    model_class("mlp")(CAMERA).save(tmp_path / "mlp.safetensors")
    words = [
        "export-model", "--calibration", tmp_path / "camera.nc",
        "--model", tmp_path / "mlp.safetensors", "-o", tmp_path / "mlp.onnx",
    ]  # fmt: skip
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    shape = onnxruntime.InferenceSession(tmp_path / "mlp.onnx").get_inputs()[0].shape
    assert shape[1] == 20


def test_what_is_missing_is_told(monkeypatch):
    with pytest.raises(InputError, match="There is no engine 'tvm'"):
        model_class("mlp")(CAMERA).with_engine("tvm")
    for name in ("ridge", "compound"):
        with pytest.raises(InputError, match="no network"):
            load_model(name, CAMERA, engine="torch")
        with pytest.raises(InputError, match="no network"):
            load_model(name, CAMERA).export("model.onnx")
    monkeypatch.setattr(engine, "find_spec", lambda name: None)
    for name in ("openvino", "onnxruntime"):
        with pytest.raises(InputError, match=r"squilla\[engine\]"):
            model_class("mlp")(CAMERA).with_engine(name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="needs an NVIDIA GPU"):
        engine.compile_network(torch.nn.Identity(), "cuda")


# --- only what is asked -------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["compound", "ridge"])
def test_parts_are_parts_of_the_whole(name):
    model, measurement = load_model(name, CAMERA), patches(CAMERA)
    whole = model.reconstruct(measurement).values
    view = model.look(measurement)
    np.testing.assert_allclose(view.bands([0, 63, -1]), whole[..., [0, 63, -1]], atol=1e-5)
    rows, columns = [0, 36, 20, 19], [0, 49, 30, 11]
    np.testing.assert_allclose(view.spectra(rows, columns), whole[rows, columns], atol=1e-5)
    weights = np.random.default_rng(0).uniform(0, 0.01, (126, 3))
    np.testing.assert_allclose(view.mixed(weights), whole @ weights, rtol=0.02, atol=0.02)
    np.testing.assert_allclose(view.cube().values, whole, atol=1e-5)
    assert np.isnan(view.bands([5])[30, 7]).all()
    with pytest.raises(InputError, match="numbered 0 to 125"):
        view.bands([126])
