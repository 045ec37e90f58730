"""From a GigE Vision camera on the network to what the page gets: the twin sends, squilla shows."""

import json
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from serving import Line, running
from squilla.calibration.alignment import measure
from squilla.calibration.store import save_calibration
from squilla.cli.app import app
from squilla.errors import InputError
from squilla.files.raw import Raw
from squilla.live.connection import Region
from squilla.live.genicam import LiveCamera
from squilla.live.pipeline import LiveSource
from squilla.live.source import open_source
from squilla.live.twin_camera import TwinCamera
from squilla.live.twin_frames import TwinFrames
from squilla.reconstruction.models import load_model
from twin_process import installed

HERE = "genicam:127.0.0.1"


@pytest.fixture(scope="module")
def frames(camera, scene):
    return TwinFrames(camera, [camera.rate(scene)])


@pytest.fixture
def twin(frames, port):
    with TwinCamera(frames, rate=20.0) as twin:
        yield twin


@pytest.fixture
def opened(twin):
    """Return the camera as the live view opens it."""
    camera = open_source(HERE, "thesis", "chart")
    assert isinstance(camera, LiveCamera)
    yield camera
    camera.close()


def show(line: Line) -> tuple[dict, list]:
    """Return the status and the answers of the next frame, and acknowledge it."""
    answers = []
    while True:
        header, values = line.receive()
        if header.get("id") == 77:
            assert "error" not in header, header
            continue
        assert "frame" in header, header
        if header.get("last"):
            line.socket.send(json.dumps({"ask": "acknowledge", "frame": header["frame"]}))
            return header["status"], answers
        answers.append(values)


def until(line: Line, test, seconds: float = 60.0) -> tuple[dict, list]:
    end = time.monotonic() + seconds
    while True:
        status, answers = show(line)
        if test(status):
            return status, answers
        assert time.monotonic() < end, status


@installed
def test_from_the_wire_to_the_page(opened, twin, frames, calibration):
    """What the page gets is what the frames of the twin give; exposure and gain reach the camera,
    automatic exposure finds its way back."""
    model = load_model("ridge", calibration)
    good = opened.exposure
    source = LiveSource(opened, calibration, model)
    with running(source) as address:
        line = Line(address)
        about = line.hello["sources"][0]
        assert about["exposures"] == [0.01, 10000.0]
        assert about["gains"] == [0.0, 24.0]
        wanted = [{"kind": "band", "band": 20}, {"ask": "spectra", "regions": [[30, 30, 31, 31]]}]
        line.socket.send(json.dumps({"ask": "watch", "wanted": wanted}))
        status, (band, spectra) = until(line, lambda status: not status["error"])
        frame = frames.draw(status["taken"], status["exposure"], status["gain"])
        expected = model.reconstruct(measure(Raw(frame, status["exposure"]), calibration)).values
        error = np.sqrt(np.mean((band[0] - expected[..., 20]) ** 2))
        assert error < 2e-3 * expected[..., 20].mean(), "the same frame; places from the one before"
        np.testing.assert_allclose(
            spectra[0, 0], expected[30, 30], atol=0.02 * expected[30, 30].max()
        )
        assert status["gain"] == 0
        assert status["distance"] == pytest.approx(300, rel=0.1)

        def wish(**wanted):
            line.socket.send(json.dumps({"id": 77, "ask": "control", **wanted}))

        wish(name="gain", value=6.0)
        wish(name="exposure", value=good / 3)
        third = pytest.approx(good / 3, rel=1e-3)
        until(line, lambda told: told["gain"] == 6.0 and told["exposure"] == third)
        assert opened.exposure == third
        wish(name="automatic", value=True)
        until(line, lambda told: told["exposure"] == pytest.approx(good / 2, rel=0.3))
        line.socket.close()
    source.close()


@installed
def test_an_unplugged_camera_is_said_and_comes_back(frames, calibration, port, capfd):
    model = load_model("ridge", calibration)
    with TwinCamera(frames, rate=20.0) as twin:
        camera = open_source(HERE, "thesis", "chart")
        source = LiveSource(camera, calibration, model)
        with running(source) as address:
            line = Line(address)
            wanted = [{"kind": "band", "band": 20}]
            line.socket.send(json.dumps({"ask": "watch", "wanted": wanted}))
            show(line)
            twin.close()
            status, answers = until(line, lambda told: told["error"])
            assert "does not answer any more. Looking for it" in status["error"]
            assert answers[0].shape == (1, 60, 60), "the last good picture stays"
            with TwinCamera(frames, rate=20.0):
                until(line, lambda told: not told["error"])
                assert camera.statistics.reconnected == 1
                line.socket.close()
                source.close()
    said = capfd.readouterr().err
    assert "does not answer any more. Looking for it" in said
    assert "is back after" in said


@installed
def test_a_camera_of_another_size_is_refused(opened, calibration):
    opened.region = Region(240, 300)
    with pytest.raises(InputError, match="240 x 300 px, the calibration was made for 480 x 500"):
        LiveSource(opened, calibration, load_model("ridge", calibration))


@installed
def test_commands_refuse_in_one_sentence(port, calibration, tmp_path):
    """A camera that is not there, a source that is none: said in the terminal, exit code 2."""
    save_calibration(calibration, tmp_path / "camera.nc")
    for source, said in (
        ("genicam:nobody", "There is no camera 'nobody'"),
        ("genicam", "No GenICam camera answers"),
        ("webcam", "There is no source 'webcam'"),
    ):
        words = ["live", "--source", source, "--calibration", str(tmp_path / "camera.nc")]
        result = CliRunner().invoke(app, [*words, "--no-browser"])
        assert isinstance(result.exception, InputError), result.output
        assert said in str(result.exception)
