"""The live view: the newest frame, right numbers, wishes to the camera, recording."""

import errno
import json
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress

import numpy as np
import pytest
import torch
import xarray as xr

from browser import MISSING, Browser, find
from conftest import small_design
from serving import Line, running
from squilla.calibration.alignment import measure
from squilla.camera.twin import Camera
from squilla.colour import rgb_weights
from squilla.errors import InputError
from squilla.evaluation.metrics import sam
from squilla.files.raw import Raw, read_raws, write_raw
from squilla.live.answer import colour_bands
from squilla.live.connection import Statistics
from squilla.live.frame import LiveFrame
from squilla.live.pipeline import LiveSource
from squilla.live.protocol import Picture, Spectra
from squilla.live.record import Recorder
from squilla.live.source import FolderFrames, MovingTwin, open_source
from squilla.reconstruction.models import load_model


class Stack:
    """A camera that shows given frames, the last one again and again."""

    def __init__(self, frames: list[Raw]):
        self.frames, self.statistics = frames, Statistics()
        self.exposure: float | None = frames[0].exposure
        self.gain, self.exposures, self.gains = 0.0, (0.01, 1000.0), (0.0, 24.0)

    def check_size(self, shape) -> None:
        pass

    def read(self, *, timeout: float = 5.0) -> Raw:
        time.sleep(0.01)
        raw = self.frames[min(self.statistics.delivered, len(self.frames) - 1)]
        self.statistics.delivered += 1
        return raw

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def frames(camera, scene) -> list[Raw]:
    rate = camera.rate(scene)
    generator = torch.Generator().manual_seed(1)
    exposure = camera.sensor.exposure_for(camera.fields(rate), 30.0)
    return [camera.expose(rate * (1 + 0.1 * n), exposure, generator) for n in range(3)]


@pytest.fixture
def live(frames, calibration) -> Iterator[LiveSource]:
    source = LiveSource(Stack(frames), calibration, load_model("ridge", calibration))
    source._first.wait(60)  # compiles what measures
    yield source
    source.close()


def until(test, seconds: float = 60.0):
    end = time.monotonic() + seconds
    while not (value := test()):
        assert time.monotonic() < end, "never came true"
        time.sleep(0.01)
    return value


def test_a_live_frame_is_what_measuring_and_reconstructing_give(live, frames, calibration):
    """From the frame before the places are found as well as without; bands and pixels alone are
    what they are in the whole cube."""
    frame = until(lambda: (now := live.now()).number >= 4 and now)
    model, measured = load_model("ridge", calibration), measure(frames[-1], calibration)
    cube = model.reconstruct(measured).values
    picture, _ = frame.picture(Picture(kind="band", band=7))
    assert np.sqrt(np.mean((picture[0] - cube[..., 7]) ** 2)) < 1e-3 * cube[..., 7].mean()
    cube = model.reconstruct(frame._measurement).values
    np.testing.assert_allclose(picture[0], cube[..., 7], rtol=1e-5)
    (mean, spread), _ = frame.spectra(Spectra(regions=[(10, 20, 11, 21), (30, 30, 40, 36)]))
    np.testing.assert_allclose(mean[0], cube[10, 20], rtol=1e-5)
    np.testing.assert_allclose(mean[1], cube[30:40, 30:36].mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(spread[1], cube[30:40, 30:36].std((0, 1)), rtol=1e-3, atol=1e-5)
    assert frame._looked._cube is None, "nobody asked for the whole cube"
    colour, _ = frame.picture(Picture(kind="colour"))
    bands = colour_bands(51)
    expected = np.moveaxis(cube[..., bands] @ rgb_weights(model.wavelength[bands]), -1, 0)
    np.testing.assert_allclose(colour, expected, rtol=1e-3, atol=1e-5 * expected.max())
    angle, _ = frame.picture(Picture(kind="angle", spectrum=cube[10, 20].tolist()))
    np.testing.assert_allclose(angle[0], sam(cube, cube[10, 20]), atol=1e-3)
    told = frame.status()
    assert told["exposure"] == frames[-1].exposure
    assert told["distance"] == pytest.approx(300, rel=0.1)
    assert told["saturated"] == 0
    assert {"frame", "measure", "decode"} <= told["stages"].keys()


def test_what_was_asked_of_a_frame_is_expected_of_the_next(live):
    shown = live.now()

    def frame(before: LiveFrame | None) -> LiveFrame:
        return LiveFrame(
            9, shown._measurement, shown._model, {"stages": {}}, nullcontext(), dict, before
        )

    def band(frame: LiveFrame, number: int) -> None:
        frame.picture(Picture(kind="band", band=number))

    first = frame(None)
    band(first, 3)
    band(first, 9)
    second = frame(first)
    band(second, 9)
    assert second._places.keys() == {3, 9}
    third = frame(second)
    band(third, 9)
    fourth = frame(third)
    band(fourth, 5)
    assert fourth._places.keys() == {5, 9}, "what nobody asks for any more is left"


def reads(source: LiveSource, count: int) -> None:
    """Wait until so many more frames left the camera; what was under way is then shown."""
    before = source._source.statistics.delivered
    until(lambda: source._source.statistics.delivered >= before + count)


def test_freeze_and_step(live):
    until(lambda: live.now().number >= 3)
    shown = live.now()
    live.control("frozen", True)
    assert shown.status()["frozen"]  # also of a frame that was measured before
    reads(live, 2)
    number = live.now().number
    reads(live, 10)
    assert live.now().number == number
    live.control("step", None)
    until(lambda: live.now().number == number + 1)
    reads(live, 10)
    assert live.now().number == number + 1
    live.control("frozen", False)
    until(lambda: live.now().number > number + 2)


def test_nobody_looking_nothing_is_measured(live, monkeypatch):
    monkeypatch.setattr("squilla.live.pipeline._ATTENTION", 0.1)
    until(lambda: live.now().number >= 2)
    until(lambda: time.monotonic() - live._looked > 0.1)
    reads(live, 2)
    number = live._frame.number
    reads(live, 10)
    assert live._frame.number == number
    until(lambda: live.now().number > number)


def test_trouble_is_told_and_passes(frames, calibration):
    dark = Raw(np.zeros_like(frames[0].frame) + 64, frames[0].exposure, frames[0].metadata)
    stack = Stack([frames[0], dark])
    source = LiveSource(stack, calibration, load_model("ridge", calibration))
    error = until(lambda: source.now().status()["error"])
    assert "dark" in error
    stack.frames = [frames[0]]
    until(lambda: source.now().status()["error"] is None)
    source.close()


def test_wishes(live):
    assert live.control("exposure", 3.5)["exposure"] == 3.5
    assert live.control("gain", 6.0)["gain"] == 6.0
    for name in ("exposure", "gain"):
        for value in (None, True):
            with pytest.raises(InputError, match="must be a number"):
                live.control(name, value)
    with pytest.raises(InputError, match="--record"):
        live.control("recording", True)


@pytest.mark.parametrize("wrong", [0.02, 30.0])
def test_automatic_exposure_brings_the_light_where_it_belongs(camera, scene, calibration, wrong):
    """From far too short or far too long, within a few frames; a hand at the dial ends it."""
    twin = MovingTwin(camera, scene, rate=50)
    good = twin.exposure
    twin.exposure = wrong * good
    source = LiveSource(twin, calibration, load_model("ridge", calibration))
    source.control("automatic", True)
    until(lambda: twin.exposure == pytest.approx(good, rel=0.25))

    def shown() -> bool:
        with suppress(InputError):  # no picture yet; but who looks keeps the view awake
            return source.now().status()["error"] is None
        return False

    until(shown)
    until(lambda: source.now().status()["exposure"] == twin.exposure)
    assert source.now().status()["saturated"] < 0.01
    told = source.control("exposure", good / 2)
    assert (told["automatic"], told["exposure"]) == (False, good / 2)
    source.close()


def test_frames_of_another_size_are_refused(frames, camera, calibration, tmp_path):
    small = Raw(frames[0].frame[:400, :400], 1.0, {})
    write_raw(tmp_path / "small.tiff", small)
    model = load_model("ridge", calibration)
    for source in (FolderFrames(tmp_path), MovingTwin(Camera(small_design(field={"size": 40})))):
        shape = (9, 9) if isinstance(source, MovingTwin) else calibration.pixels.bias.shape
        with pytest.raises(InputError, match="the calibration was made for"):
            source.check_size(shape)
        source.close()
    with pytest.raises(InputError, match="400 x 400 px, the calibration was made for 480 x 500"):
        LiveSource(FolderFrames(tmp_path), calibration, model)


class Full:
    """A disk with room for some frames, then for half a frame more."""

    def __init__(self, room: int, real):
        self.room, self.real = room, real

    def __call__(self, *arguments, **options):
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.room -= 1
        return self.real(*arguments, **options)


@pytest.mark.parametrize("name", ["frames", "cubes.zarr"])
def test_what_was_recorded_before_the_disk_was_full_stays_readable(
    frames, calibration, tmp_path, monkeypatch, name
):
    recorder = Recorder(tmp_path / name)
    model = load_model("ridge", calibration)
    source = LiveSource(Stack(frames), calibration, model, recorder=recorder)
    source.control("recording", True)
    until(lambda: recorder.written >= 2)
    if name == "frames":
        import tifffile

        monkeypatch.setattr(tifffile, "imwrite", Full(1, tifffile.imwrite))
    else:
        from zarr.storage import LocalStore

        real = LocalStore.set

        async def full(self, key, value, **options):
            if "radiance/c" in key and full.room == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            full.room -= "radiance/c" in key
            return await real(self, key, value, **options)

        full.room = 3
        monkeypatch.setattr(LocalStore, "set", full)
    said = until(lambda: source.now().status()["record_error"])
    assert "No space left" in said
    until(lambda: recorder.missed > 0)
    written = recorder.written
    monkeypatch.undo()
    source.close()
    assert written >= 2
    if name == "frames":
        assert len(list(read_raws(tmp_path / name))) == written
    else:
        with xr.open_zarr(tmp_path / name, consolidated=False) as back:
            assert back.sizes["time"] == written
            assert np.isfinite(back.radiance.values).all()


@pytest.mark.parametrize("name", ["frames", "cubes.zarr"])
def test_recording(frames, calibration, tmp_path, name):
    recorder = Recorder(tmp_path / name)
    source = LiveSource(
        Stack(frames), calibration, load_model("ridge", calibration), recorder=recorder
    )
    source.control("recording", True)
    until(lambda: recorder.written >= 3)
    told = source.control("recording", False)
    source.close()
    assert told["recorded"] == recorder.written >= 3
    assert recorder.error is None
    if name == "frames":
        back = list(read_raws(tmp_path / name))
        assert len(back) == told["recorded"]
        assert any(np.array_equal(back[-1].frame, each.frame) for each in frames)
        assert back[0].exposure == frames[0].exposure
        assert Recorder(tmp_path / name)._number == told["recorded"], "gone on with, not replaced"
    else:
        with xr.open_zarr(tmp_path / name, consolidated=False) as back:
            assert back.radiance.dims == ("time", "y", "x", "wavelength")
            assert back.sizes["time"] == told["recorded"]
        with pytest.raises(InputError, match="exists"):
            Recorder(tmp_path / name)


def test_the_twin_moves_and_obeys(camera, scene, calibration):
    twin = MovingTwin(camera, scene, rate=50)
    until(lambda: twin.poses == 8)
    seen = []

    def both_ways() -> bool:
        seen.append(measure(twin.read(), calibration).provenance["distance"])
        return min(seen) < 275 and max(seen) > 325

    until(both_ways)
    before = twin.read().frame.mean()
    twin.exposure = twin.exposure / 4
    assert twin.read().frame.mean() < 0.5 * before
    with pytest.raises(InputError, match="exposure"):
        twin.exposure = float("nan")
    twin.close()


def test_a_folder_is_played_again_and_again(frames, tmp_path):
    for number, raw in enumerate(frames):
        write_raw(tmp_path / f"{number}.tiff", raw)
    source = open_source(str(tmp_path), "thesis", "chart")
    assert isinstance(source, FolderFrames)
    for number in (0, 1, 2, 0, 1):
        np.testing.assert_array_equal(source.read().frame, frames[number].frame)
    assert source.exposures is None
    with pytest.raises(InputError, match="taken with"):
        source.exposure = 3.0
    for wrong in ("webcam", str(tmp_path / "none")):
        with pytest.raises(InputError, match="twin"):
            open_source(wrong, "thesis", "chart")


# --- over the line ------------------------------------------------------------------------------


def test_frames_wait_for_the_page(live):
    """A page gets the newest frame, and the next one only when it has shown this one."""
    with running(live) as address:
        line = Line(address)
        wanted = [
            {"kind": "band", "band": 3, "id": 5},
            {"ask": "spectra", "regions": [[0, 0, 9, 9]]},
        ]
        line.socket.send(json.dumps({"ask": "watch", "wanted": wanted}))
        seen = []
        for _ in range(3):
            parts = [line.receive() for _ in range(3)]
            number = parts[0][0]["frame"]
            assert [header["frame"] for header, _ in parts] == [number] * 3
            assert parts[0][1].shape == (1, 60, 60)
            assert parts[1][1].shape == (2, 1, 51)
            assert parts[2][0]["last"]
            with pytest.raises(TimeoutError):
                line.socket.recv(timeout=0.2)
            seen.append(number)
            line.socket.send(json.dumps({"ask": "acknowledge", "frame": number}))
        assert seen[0] < seen[1] < seen[2]
        line.socket.close()


def test_the_last_of_many_wishes_is_answered(live):
    """A page that changes its mind in the middle of answers gets what it asked for last."""
    with running(live) as address:
        line = Line(address)
        number = 0
        for number in range(1, 200):
            wanted = [{"kind": "band", "band": 3, "id": number}] * 4
            line.socket.send(json.dumps({"ask": "watch", "wanted": wanted}))
            time.sleep(0.0002 * (number % 16))
        while line.receive()[0].get("id") != number:
            pass
        line.socket.close()


@pytest.mark.skipif(find() is None, reason=MISSING)
def test_the_page_shows_the_twin_alive(camera, scene, calibration, tmp_path):
    """Pictures and spectra change by themselves; freezing stops them, exposure reaches the twin."""
    twin = MovingTwin(camera, scene, rate=30)
    model = load_model("ridge", calibration)
    source = LiveSource(twin, calibration, model, recorder=Recorder(tmp_path / "frames"))
    with running(source) as address, Browser() as browser:
        page = browser.page()
        page.open(f"http://{address}/")
        page.wait("performance.getEntriesByName('squilla first picture').length > 0", 120)
        page.click("#picture")
        value = "document.querySelector('#spectra td.number').innerText"
        first = page.wait(f"({value}).replace('…', '')")
        page.wait(f"{value} != '{first}'")
        page.js("document.querySelector('#exposure').focus()")
        page.js("(e => { e.value = 1.25; e.dispatchEvent(new Event('change')); })"
                "(document.querySelector('#exposure'))")  # fmt: skip
        until(lambda: twin.exposure == 1.25)
        page.click("#record")
        page.wait("document.querySelector('#recorded').innerText.includes('recorded')")
        page.click("#freeze")
        page.wait("document.querySelector('#freeze').getAttribute('aria-pressed') == 'true'")
        reads(source, 2)
        page.wait(f"document.querySelector('#live').dataset.frame == {source._frame.number}")
        still = page.js(value)
        reads(source, 10)
        assert page.js(value) == still
        page.click("#step")
        page.wait(f"{value} != '{still}'")
        page.click("#automatic")
        until(lambda: source._automatic)
        page.js("(e => { e.value = 3; e.dispatchEvent(new Event('change')); })"
                "(document.querySelector('#gain'))")  # fmt: skip
        until(lambda: twin.gain == 3)
        assert "/s" in str(page.js("document.querySelector('#facts').innerText"))
        assert page.complaints() == []
    source.close()
