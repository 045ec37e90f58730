"""Training: the noise is what it says, nothing depends on interruptions, and networks learn."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import squilla
from random_camera import smooth_camera
from squilla import CameraDesign, InputError
from squilla.priors import broad_spectra, gaussian_mixtures
from squilla.reconstruction.linear import Ridge
from squilla.reconstruction.models import load_model
from squilla.training.data import Samples
from squilla.training.fit import train
from squilla.training.noise import SensorNoise, add_gain_errors, add_noise, drop_channels

CAMERA = smooth_camera(0, filters=12, bands=40, angles=3)
SHORT = {"count": 60, "epochs": 25, "batch": 32, "progress": False}


# --- noise ----------------------------------------------------------------------------------


@settings(deadline=None)  # a busy machine is no failure
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


def test_a_sensors_noise_is_shot_read_and_rounding():
    """Poisson, Gaussian and uniform variances add: e + r^2 + g^2 / 12."""
    generator = torch.Generator().manual_seed(0)
    for read, gain in ((0.0, 0.01), (3.0, 0.01), (0.5, 6.0)):
        sensor = SensorNoise(10_000, read, gain, exposure=(0.1, 0.1))
        y = torch.tensor([1.0, 0.5, 0.02]).expand(50_000, 3).double()
        seen = 1000 * add_noise(y, sensor, generator)  # electrons
        electrons = 1000 * y[0]
        torch.testing.assert_close(seen.mean(0), electrons, rtol=5e-3, atol=0.1)
        expected = electrons + read**2 + gain**2 / 12
        torch.testing.assert_close(seen.var(0), expected, rtol=0.04, atol=0)
        steps = seen / gain
        assert (steps - steps.round()).abs().max() < 1e-6


def test_a_sensor_is_exposed_evenly_in_the_logarithm():
    generator = torch.Generator().manual_seed(0)
    sensor = SensorNoise(1e6, 0.0, 1e-3, exposure=(0.01, 1.0))
    y = torch.ones(2000, 400)
    share = (add_noise(y, sensor, generator) - y).double().var(-1).reciprocal() / 1e6
    np.testing.assert_allclose(np.sort(share.log10()), np.linspace(-2, 0, 2000), atol=0.12)


def test_a_designs_sensor_and_its_unit_do_not_matter():
    design = CameraDesign.load("thesis")
    sensor = SensorNoise.of(design.sensor)
    assert (sensor.full_well, sensor.read_noise) == (11_000, 2.5)
    y = torch.rand(50, 36) + 0.1
    first, second = (
        add_noise(scale * y, sensor, torch.Generator().manual_seed(3)) / scale for scale in (1, 64)
    )
    torch.testing.assert_close(first, second)
    with pytest.raises(InputError, match="parts between 0 and 1"):
        SensorNoise(11_000, 2.5, 2.8, exposure=(0.0, 0.5))
    with pytest.raises(InputError, match="no negative"):
        SensorNoise(11_000, -2.5, 2.8)


def test_gain_errors_are_factors_with_the_stated_deviation():
    generator = torch.Generator().manual_seed(0)
    y = 0.5 + torch.rand(5000, 40, generator=generator)
    factor = (add_gain_errors(y, 0.05, generator) / y).double()
    assert float(factor.mean()) == pytest.approx(1, abs=1e-3)
    assert float(factor.std()) == pytest.approx(0.05, rel=0.01)
    assert float(torch.corrcoef(factor.T).fill_diagonal_(0).abs().max()) < 0.07  # one for each


@pytest.mark.parametrize(("channels", "share"), [(36, 0.1), (36, 0.5), (5, 0.5), (1, 0.5)])
def test_channels_are_lost_as_often_as_stated_but_never_too_many(channels, share):
    generator = torch.Generator().manual_seed(0)
    kept = drop_channels(torch.ones(20_000, channels), share, generator)
    assert int(kept.sum(-1).min()) >= (channels + 1) // 2
    if share == 0.1:
        assert float(kept.float().mean()) == pytest.approx(0.9, abs=0.002)


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


def test_lost_channels_are_filled_from_the_others():
    whole, part = (Samples(CAMERA, count=400, noise=None, dropped=share) for share in (0, 0.2))
    ((y, _, x),) = part.batches(0, 400)
    ((_, angle, same),) = whole.batches(0, 400)
    assert torch.equal(x, same)
    expected = CAMERA.project(x, angle)
    expected = expected / expected.amax(-1, keepdim=True)
    off = (y - expected).abs()
    assert y.isfinite().all()
    assert 0.6 < float((off < 1e-6).float().mean()) < 0.85  # also where the maximum was lost
    assert float(off.mean()) < 0.05


def test_senseless_disturbances_are_refused():
    for wrong in ({"gain_error": -0.1}, {"gain_error": 1.5}, {"dropped": 0.6}):
        with pytest.raises(InputError, match="make no sense"):
            Samples(CAMERA, **wrong)


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


def test_half_precision_learns_the_same(tmp_path):
    """bfloat16 has 8 bits: the loss after some epochs agrees to a few per cent."""
    setting = {**SHORT, "count": 512, "epochs": 8, "learning_rate": 1e-3}
    full, half = (
        train("respecnn", CAMERA, **setting, precision=precision).provenance["validation"]
        for precision in ("float32", "bfloat16")
    )
    assert half != full
    assert half == pytest.approx(full, rel=0.05)


def test_batches_in_pieces_have_the_gradient_of_the_whole(monkeypatch):
    setting = SHORT | {"epochs": 3}
    whole = train("cnn", CAMERA, **setting)
    monkeypatch.setattr("squilla.reconstruction.networks.CNN.piece", 7)
    for one, other in zip(
        whole.parameters(), train("cnn", CAMERA, **setting).parameters(), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


def test_spectra_are_shown_while_it_learns():
    seen = []
    train("mlp", CAMERA, **SHORT, look=lambda *shown: seen.append(shown))
    assert [epoch for epoch, _, _ in seen] == [9, 19, 24]
    assert all(truth.shape == found.shape == (6, 40) for _, truth, found in seen)
    assert torch.equal(seen[0][1], seen[1][1])
    assert not torch.equal(seen[0][2], seen[1][2])


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
    with pytest.raises(InputError, match="too few to learn from"):
        train("compound", CAMERA, count=-1)
    with pytest.raises(InputError, match="leave out epochs"):
        train("compound", CAMERA, epochs=0)
    for noise in ([15, 20], "20", (15.0, 20.0, 25.0)):
        with pytest.raises(InputError, match="pair"):
            train("mlp", CAMERA, noise=noise)
    with pytest.raises(InputError, match="no schedule"):
        train("mlp", CAMERA, schedule="linear")
    with pytest.raises(InputError, match="no precision"):
        train("mlp", CAMERA, precision="int4")
    for device in ("cuda:99", "abacus"):
        with pytest.raises(InputError, match="no device"):
            train("mlp", CAMERA, device=device)
    with pytest.raises(InputError, match="seed"):
        train("mlp", CAMERA, seed=-1)
    with pytest.raises(InputError, match="diverged"):
        train("mlp", CAMERA, **SHORT, learning_rate=1e9)


def test_files_are_looked_for_before_the_training(tmp_path):
    for name in ("log", "checkpoint"):
        with pytest.raises(InputError, match="no such folder"):
            train("mlp", CAMERA, **{name: tmp_path / "none" / "file"})


def test_compound_refuses_what_it_does_not_take(monkeypatch):
    with pytest.raises(InputError, match="leave out noise, look"):
        train("compound", CAMERA, noise=20, look=print)
    with pytest.raises(InputError, match="leave out precision"):
        train("compound", CAMERA, precision="bfloat16")
    with pytest.raises(InputError, match="leave out epochs, checkpoint"):
        train("compound", CAMERA, epochs=7, checkpoint="run.checkpoint")


# --- the command ----------------------------------------------------------------------------


def test_noise_as_it_is_typed():
    from squilla.cli.train import parse_noise

    assert parse_noise("none") is None
    assert parse_noise("20") == 20
    assert parse_noise("15:20") == (15, 20)
    assert parse_noise("thesis") == SensorNoise.of(CameraDesign.load("thesis").sensor)
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


@pytest.fixture
def command(tmp_path):
    """A training by the command line, and the environment of its process."""
    CAMERA.save(tmp_path / "camera.nc")
    source = str(Path(squilla.__file__).parent.parent)
    words = ["train", "--calibration", str(tmp_path / "camera.nc"), "--noise", "15:20", "--model",
             "respecnn", "--count", "256", "--batch", "64", "--epochs", "60", "-o"]  # fmt: skip
    return words, os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": source}


def weights(path):
    return load_model(path, CAMERA).state_dict()


MAIN = [sys.executable, "-c", "import sys; from squilla.cli import main; sys.exit(main())"]


@pytest.mark.slow
def test_a_killed_command_goes_on_to_the_same_bits(command, tmp_path):
    words, environment = command
    straight, broken = tmp_path / "straight.safetensors", tmp_path / "broken.safetensors"
    subprocess.run([*MAIN, *words, straight], env=environment, check=True, timeout=300)
    state, log = tmp_path / "state.checkpoint", tmp_path / "log.jsonl"
    words = [*MAIN, *words, broken, "--checkpoint", state, "--log", log]
    for least in (12, 33):  # killed between two checkpoints, twice
        process = subprocess.Popen(words, env=environment)
        deadline = time.monotonic() + 300
        while not log.exists() or len(log.read_text().splitlines()) < least:
            assert process.poll() is None, "it ended before it was killed"
            assert time.monotonic() < deadline
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert state.exists()
        assert not broken.exists()
    subprocess.run(words, env=environment, check=True, timeout=300)
    expected, found = weights(straight), weights(broken)
    assert all(torch.equal(expected[key], found[key]) for key in expected)
    assert len(log.read_text().splitlines()) == 60


@pytest.mark.slow
def test_two_processes_train_as_one(command, tmp_path):
    words, environment = command
    words[words.index("--epochs") + 1] = "3"
    alone, together = tmp_path / "alone.safetensors", tmp_path / "together.safetensors"
    subprocess.run([*MAIN, *words, alone], env=environment, check=True, timeout=300)
    script = tmp_path / "main.py"
    script.write_text("import sys; from squilla.cli import main; sys.exit(main())")
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    subprocess.run([*launch, script, *words, together], env=environment, check=True, timeout=300)
    expected, found = weights(alone), weights(together)
    for key in expected:
        torch.testing.assert_close(found[key], expected[key], rtol=1e-3, atol=1e-5)
