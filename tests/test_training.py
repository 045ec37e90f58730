"""Training: the noise is what it says, nothing depends on interruptions, and networks learn."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from random_camera import smooth_camera
from squilla import InputError
from squilla.reconstruction.linear import Ridge
from squilla.reconstruction.reconstructor import load_model
from squilla.spectra import broad_spectra, gaussian_mixtures
from squilla.training.data import Samples
from squilla.training.fit import train
from squilla.training.noise import add_noise

CAMERA = smooth_camera(0, filters=12, bands=40, angles=3)
SHORT = {"count": 60, "epochs": 25, "batch": 32, "progress": False}


# --- noise ----------------------------------------------------------------------------------


@given(st.floats(0, 60), st.floats(1e-3, 1e6))
def test_noise_has_the_stated_ratio(snr, scale):
    generator = torch.Generator().manual_seed(0)
    y = scale * torch.rand(200, 500, generator=generator)
    noise = (add_noise(y, snr, generator) - y).double()
    ratio = 20 * torch.log10(y.double().norm(dim=-1) / noise.norm(dim=-1))
    assert float(ratio.mean()) == pytest.approx(snr, abs=0.1)
    assert abs(float(noise.mean())) < 5 * float(noise.std()) / noise.numel() ** 0.5


def test_a_pair_draws_evenly_between_its_ends():
    generator = torch.Generator().manual_seed(0)
    y = torch.ones(4000, 2000)
    noise = add_noise(y, (10, 20), generator) - y
    ratio = np.sort(-20 * np.log10(noise.square().mean(-1).sqrt().numpy()))
    np.testing.assert_allclose(ratio, np.linspace(10, 20, 4000), atol=0.6)


def test_no_noise_and_senseless_noise():
    y = torch.rand(3, 4)
    assert add_noise(y, None) is y
    for senseless in (float("nan"), (20, 10), (0, float("inf"))):
        with pytest.raises(InputError, match="cannot be drawn"):
            add_noise(y, senseless)


# --- samples --------------------------------------------------------------------------------


def test_samples_are_what_the_camera_measures():
    samples = Samples(CAMERA, count=50, noise=None)
    ((y, angle, x),) = samples.batches(0, 50)
    expected = CAMERA.project(x, angle)
    torch.testing.assert_close(y, expected / expected.amax(-1, keepdim=True))
    assert angle.min() >= CAMERA.angle[0]
    assert angle.max() <= CAMERA.angle[-1] + 1e-6


def test_angles_fill_the_image_evenly():
    samples = Samples(CAMERA, count=4000, noise=None)
    ((_, angle, _),) = samples.batches(0, 4000)
    share = np.sort(angle.numpy()) ** 2 / CAMERA.angle[-1] ** 2
    np.testing.assert_allclose(share, np.linspace(0, 1, 4000), atol=0.05)


def test_epochs_stand_alone_and_differ():
    fresh, kept = Samples(CAMERA, count=20), Samples(CAMERA, count=20, fresh=False)
    assert torch.equal(fresh.draw(7), fresh.draw(7))
    assert not torch.equal(fresh.draw(7), fresh.draw(8))
    assert torch.equal(kept.draw(7), kept.draw(8))
    first, second = (torch.cat([y for y, _, _ in kept.batches(n, 7)]) for n in (0, 1))
    assert first.shape == (20, 12)
    assert not torch.equal(first.sort(0).values, second.sort(0).values)  # the noise is new


def test_the_thesis_set_is_gaussian_mixtures():
    samples = Samples(CAMERA, "gaussian", 30, fresh=False, seed=2)
    other = gaussian_mixtures(30, CAMERA.wavelength, generator=samples._generator(0, 0))
    assert torch.equal(samples.draw(5), other)


def test_unknown_priors_are_refused():
    with pytest.raises(InputError, match="gaussian, natural, line, broad"):
        Samples(CAMERA, "planck")


# --- training -------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "schedule"), [("mlp", "cosine"), ("respecnn", "constant")])
def test_an_interrupted_training_ends_at_the_same_bits(name, schedule, tmp_path, monkeypatch):
    setting = SHORT | {"schedule": schedule, "learning_rate": 1e-3}
    if name != "mlp":
        setting["epochs"] = 13
    straight = train(name, CAMERA, **setting, log=tmp_path / "straight.jsonl")
    files = {"log": tmp_path / "broken.jsonl", "checkpoint": tmp_path / "broken.pt"}
    draw = Samples.draw

    def draw_until_twelve(self, epoch):
        if epoch == 12:
            raise KeyboardInterrupt
        return draw(self, epoch)

    with monkeypatch.context() as patch:
        patch.setattr(Samples, "draw", draw_until_twelve)
        with pytest.raises(KeyboardInterrupt):
            train(name, CAMERA, **setting, **files)
    assert len(files["log"].read_text().splitlines()) == 12
    resumed = train(name, CAMERA, **setting, **files)
    assert resumed.provenance == straight.provenance
    for key, value in straight.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[key])

    def story(path):
        entries = [json.loads(line) for line in path.read_text().splitlines()]
        return [{key: e[key] for key in ("epoch", "loss", "validation")} for e in entries]

    assert story(files["log"]) == story(tmp_path / "straight.jsonl")


def test_a_finished_training_is_not_repeated(tmp_path, monkeypatch):
    first = train("mlp", CAMERA, **SHORT, checkpoint=tmp_path / "state.pt")
    monkeypatch.setattr("squilla.training.fit._Run.epoch", None)
    again = train("mlp", CAMERA, **SHORT, checkpoint=tmp_path / "state.pt")
    assert again.provenance == first.provenance


def test_checkpoints_of_other_trainings_are_refused(tmp_path):
    path = tmp_path / "state.pt"
    train("mlp", CAMERA, **SHORT, checkpoint=path)
    with pytest.raises(InputError, match="differs in noise, seed"):
        train("mlp", CAMERA, **SHORT, noise=20, seed=1, checkpoint=path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="not a checkpoint"):
        train("mlp", CAMERA, **SHORT, checkpoint=path)


def test_seeds_decide_and_the_callers_random_numbers_stay():
    torch.manual_seed(11)
    before = torch.get_rng_state()
    first, same, other = (
        train("mlp", CAMERA, **(SHORT | {"epochs": 1}), seed=seed) for seed in (0, 0, 1)
    )
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(first.layers[0].weight, same.layers[0].weight)
    assert not torch.equal(first.layers[0].weight, other.layers[0].weight)


@pytest.mark.slow
def test_a_network_learns_to_do_better_than_the_linear_estimator():
    model = train(
        "mlp", CAMERA, noise=20, count=8000, epochs=60, batch=256, learning_rate=1e-3,
        schedule="cosine", progress=False,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(77)
    x = broad_spectra(2000, CAMERA.wavelength, generator=generator)
    y = add_noise(CAMERA.project(x), 20, generator)
    with torch.no_grad():
        error = (model(y) - x).square().mean()
    assert error < (Ridge(CAMERA)(y) - x).square().mean()


def test_training_lowers_the_error_and_is_remembered(tmp_path):
    model = train(
        "mlp", CAMERA, count=256, epochs=12, batch=64, learning_rate=1e-3, progress=False,
        log=tmp_path / "log.jsonl",
    )  # fmt: skip
    entries = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [entry["epoch"] for entry in entries] == list(range(12))
    assert entries[-1]["validation"] < 0.7 * entries[0]["validation"]
    model.save(tmp_path / "model.safetensors")
    again = load_model(tmp_path / "model.safetensors", CAMERA)
    assert again.provenance["noise"] == "15-20 dB"
    assert again.provenance["validation"] == entries[-1]["validation"]


def test_senseless_settings_are_refused():
    with pytest.raises(InputError, match="needs no training"):
        train("ridge", CAMERA)
    with pytest.raises(InputError, match="positive"):
        train("mlp", CAMERA, epochs=0)
    with pytest.raises(InputError, match="no schedule"):
        train("mlp", CAMERA, schedule="linear")
    for device in ("cuda:99", "abacus"):
        with pytest.raises(InputError, match="no device"):
            train("mlp", CAMERA, device=device)
    with pytest.raises(InputError, match="diverged"):
        train("mlp", CAMERA, **SHORT, learning_rate=1e9)


# --- the command ----------------------------------------------------------------------------


def test_noise_as_it_is_typed():
    from squilla.cli.train import parse_noise

    assert parse_noise("none") is None
    assert parse_noise("20") == 20
    assert parse_noise("15:20") == (15, 20)
    for wrong in ("loud", "15-20", "20:15", "1:2:3", "nan", ""):
        with pytest.raises(InputError, match="none, 20 or 15:20"):
            parse_noise(wrong)


def test_the_command_trains_and_tells(tmp_path):
    from typer.testing import CliRunner

    from squilla.cli.app import app

    CAMERA.save(tmp_path / "camera.nc")
    words = ["train", "--calibration", str(tmp_path / "camera.nc"), "--noise", "20", "--seed", "4",
             "--epochs", "2", "--count", "50", "--json", "-o"]  # fmt: skip
    result = CliRunner().invoke(app, [*words, str(tmp_path / "model.safetensors")])
    told = json.loads(result.stdout)
    assert (told["noise"], told["seed"], told["epochs"]) == ("20 dB", 4, 2)
    assert load_model(tmp_path / "model.safetensors", CAMERA).provenance["seed"] == 4
    result = CliRunner().invoke(app, [*words, str(tmp_path / "nowhere" / "model.safetensors")])
    assert isinstance(result.exception, InputError)
