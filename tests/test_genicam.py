"""Live cameras: the twin sends as a GigE Vision camera, and what arrives is what it sent."""

import _thread
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import twin_process
from squilla.camera.twin import Camera
from squilla.cli.app import app
from squilla.errors import InputError
from squilla.files.raw import read_raws
from squilla.live import aravis, gentl
from squilla.live.connection import CameraLost, Region
from squilla.live.genicam import open_camera
from squilla.live.pixel_format import FORMATS
from squilla.live.twin_camera import TwinCamera, camera_within
from squilla.live.twin_frames import TwinFrames
from twin_process import installed

HERE = "genicam:127.0.0.1"
PATIENCE = 60.0  # s; on a busy machine frames may come seldom


@pytest.fixture(scope="module")
def frames():
    return twin_process.megapixel_frames()


@pytest.fixture
def twin(frames, port):
    with TwinCamera(frames, rate=20.0) as camera:
        yield camera


def sent(frames, raw, region=None, bits=12):
    """Return what the twin sent as this frame, by its number and settings."""
    facts = raw.metadata
    frame = frames.draw(facts["frame"], raw.exposure, facts["gain"], region)
    return frame >> (12 - bits)


# --- over the wire ----------------------------------------------------------------------------


@installed
@pytest.mark.parametrize("name", FORMATS)
def test_a_megapixel_arrives_bit_exact(twin, frames, name):
    with open_camera(HERE, pixel_format=name) as camera:
        for _ in range(2):
            raw = camera.read(timeout=PATIENCE)
            assert raw.frame.shape == (1000, 1000)
            bits = min(12, FORMATS[name].bits)
            np.testing.assert_array_equal(raw.frame, sent(frames, raw, bits=bits))
        assert raw.metadata["pixel_format"] == name
        assert raw.metadata["camera"] == frames.serial


@installed
def test_exposure_and_gain_do_as_physics_says(twin, frames):
    """Photon transfer: signal and variance of frame pairs against what the client set."""
    design = frames.design.sensor
    with open_camera(HERE) as camera:
        for exposure, gain in ((4.0, 0.0), (8.0, 0.0), (8.0, 6.0)):
            camera.exposure, camera.gain = exposure, gain
            first, second = camera.read(timeout=PATIENCE), camera.read(timeout=PATIENCE)
            assert (first.exposure, first.metadata["gain"]) == (exposure, gain)
            factor = 10 ** (gain / 20) / design.gain
            electrons = frames.means[0][:, 500:520].mean() * exposure
            one, other = (raw.frame[:, 500:520].astype(float) for raw in (first, second))
            signal = (one.mean() + other.mean()) / 2 - design.black_level
            assert signal == pytest.approx(factor * electrons, rel=2e-3)
            variance = (one - other).var() / 2
            expected = factor**2 * (electrons + design.read_noise**2) + 1 / 12
            assert variance == pytest.approx(expected, rel=0.04)  # of 20 000 pixels: 1 %


@installed
def test_a_part_of_the_sensor(twin, frames):
    with open_camera(HERE) as camera:
        assert camera.sensor == (1000, 1000)
        camera.region = part = Region(200, 300, row=40, column=70)
        raw = camera.read(timeout=PATIENCE)
        np.testing.assert_array_equal(raw.frame, sent(frames, raw, part))
        assert (raw.metadata["row"], raw.metadata["column"]) == (40, 70)
        with pytest.raises(InputError, match="200 x 300 px, the calibration was made for 1000"):
            camera.check_size((1000, 1000))
        with pytest.raises(InputError, match="leaves the sensor of 1000 x 1000"):
            camera.region = Region(800, 300, row=300)


@installed
def test_a_trigger_takes_one_frame_each(twin):
    with open_camera(HERE) as camera:
        camera.trigger = "Software"
        fired = 0
        while camera.statistics.delivered < 3:
            camera.fire()
            fired += 1
            try:
                camera.read(timeout=1.0)
            except InputError:  # a busy computer loses packets, and nothing is sent twice
                assert camera.statistics.incomplete > 0
        counts = camera.statistics
        assert counts.delivered + counts.incomplete + counts.lost == fired == twin.sent
        with pytest.raises(InputError, match="no trigger came at Software"):
            camera.read(timeout=0.3)
        camera.trigger = None
        camera.read(timeout=PATIENCE)
        with pytest.raises(InputError, match="can be fired"):
            camera.fire()


@installed
def test_a_slow_reader_gets_the_newest(twin):
    with open_camera(HERE) as camera:
        reader = camera.frames()
        start = next(reader).metadata["frame"] - twin.sent  # from the twin's count to the camera's
        for pause in (0.2, 0.8):
            time.sleep(pause)
            before = twin.sent
            assert next(reader).metadata["frame"] - start >= before - 1
        reader.close()
        counts = camera.statistics
        assert counts.skipped + counts.lost > 0


@installed
def test_settings_change_under_a_running_reader(twin, frames):
    """Every frame carries the exposure that it was taken with, whoever sets it."""
    with open_camera(HERE) as camera:
        seen, shown = set(), threading.Condition()

        def change():
            for exposure in (2.0, 5.0, 3.0):
                camera.exposure = exposure
                with shown:
                    shown.wait_for(lambda exposure=exposure: exposure in seen, timeout=60)

        setter = threading.Thread(target=change)
        setter.start()
        for raw in camera.frames(timeout=PATIENCE):
            np.testing.assert_array_equal(raw.frame[::50], sent(frames, raw)[::50])
            with shown:
                seen.add(raw.exposure)
                shown.notify()
            if not setter.is_alive():
                break
        setter.join()
        assert {2.0, 3.0, 5.0} <= seen


def lose_packets(frames, seconds):
    with TwinCamera(frames, rate=25.0, lost=0.05) as twin, open_camera(HERE) as camera:
        camera.region = Region(100, 1000)  # 19 packets of data: one frame in three is whole
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            raw = camera.read(timeout=PATIENCE)
            np.testing.assert_array_equal(raw.frame, sent(frames, raw, camera.region))
        camera.close()
        counts, total = camera.statistics, twin.sent
    assert counts.incomplete > 0.2 * total
    assert counts.delivered > 0.05 * total
    came = counts.delivered + counts.skipped + counts.incomplete + counts.lost
    assert abs(came - total) <= 1  # the one on the way at the end


@installed
def test_lost_packets_cost_frames_and_nothing_else(frames, port):
    lose_packets(frames, 2.0)


@installed
@pytest.mark.slow
def test_a_minute_of_lost_packets(frames, port):
    lose_packets(frames, 60.0)


@installed
def test_a_camera_killed_and_started_again_goes_on(port):
    said = []
    with twin_process.started() as process, open_camera(HERE, report=said.append) as camera:
        camera.exposure = 7.0
        reader = camera.frames(timeout=PATIENCE)
        next(reader)
        process.kill()
        process.join()
        with twin_process.started():
            raw = next(reader)
            while camera.statistics.reconnected == 0:  # what was sent before may still wait
                raw = next(reader)
            assert raw.exposure == camera.exposure == 7.0
            assert "does not answer" in said[0]
            assert "is back after" in said[1]


@installed
@pytest.mark.slow
def test_a_camera_that_stays_away_is_said_to(frames, port):
    with TwinCamera(frames) as twin, open_camera(HERE, patience=0.5) as camera:
        camera.read(timeout=PATIENCE)
        twin.close()
        with pytest.raises(CameraLost, match=r"did not come back within 0\.5 s; see its cable"):
            for _ in camera.frames(timeout=PATIENCE):
                pass


@installed
def test_neither_memory_nor_threads_grow(twin):
    def memory():
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def use(count):
        with open_camera(HERE) as camera:
            camera.region = Region(1000, 200)
            for _ in range(count):
                camera.read(timeout=PATIENCE)
            camera.exposure = 3.0
            camera.read(timeout=PATIENCE)

    for _ in range(3):
        use(5)
    before, threads = memory(), len(os.listdir("/proc/self/task"))
    for _ in range(8):
        use(5)
    # Each of the 48 frames of 300 kB, and each of the 48 buffers, would be missed.
    assert memory() - before < 6e6
    assert len(os.listdir("/proc/self/task")) == threads


@installed
def test_an_interrupt_is_heard(twin):
    with open_camera(HERE) as camera:
        camera.trigger = "Software"
        connection, waiting = camera._connection, threading.Event()
        receive = connection.receive
        connection.receive = lambda timeout: (waiting.set(), receive(timeout))[1]

        def interrupt():
            waiting.wait(60)
            _thread.interrupt_main()

        # In the background of a shell interrupts are ignored from the start.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        threading.Thread(target=interrupt).start()
        try:
            with pytest.raises(KeyboardInterrupt):  # and not, at last, that no frame came
                camera.read(timeout=60)
        finally:
            signal.signal(signal.SIGINT, before)


# --- what a person gets wrong -----------------------------------------------------------------


@installed
def test_a_second_client_is_told(twin):
    with open_camera(HERE) as camera:
        with pytest.raises(InputError, match="controlled by another program"):
            open_camera(HERE)
        camera.read(timeout=PATIENCE)  # the first goes on


@installed
@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("genicam:nobody", "no camera 'nobody'.*`squilla cameras`"),
        ("genicam:", "No GenICam camera answers.*twin-camera"),
        ("camera-7", "named like genicam:ID or gentl:ID, not 'camera-7'"),
    ],
)
def test_an_absent_camera(port, source, said):
    with pytest.raises(InputError, match=said):
        open_camera(source)


@installed
def test_settings_out_of_range(twin):
    with open_camera(HERE) as camera:
        with pytest.raises(InputError, match=r"exposure .* from 0\.01 to 10000 ms, not 1e\+06"):
            camera.exposure = 1e6
        with pytest.raises(InputError, match=r"gain .* from 0 to 24, not -3"):
            camera.gain = -3
        camera.read(timeout=PATIENCE)
    with pytest.raises(InputError, match="closed"):
        camera.read(timeout=PATIENCE)
    with pytest.raises(InputError, match="'RGB8' cannot be used: squilla reads Mono12p"):
        open_camera(HERE, pixel_format="RGB8")


@installed
def test_one_twin_for_an_address(twin, frames):
    with pytest.raises(InputError, match=r"port 3956: .*Another twin camera may be running"):
        TwinCamera(frames)
    with pytest.raises(InputError, match=r"192\.0\.2\.77"):
        TwinCamera(frames, address="192.0.2.77")


def test_a_machine_without_the_library(monkeypatch):
    monkeypatch.setattr(aravis, "_SONAMES", ("libnothing.so",))
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    aravis.load.cache_clear()
    aravis.library.cache_clear()
    try:
        with pytest.raises(InputError, match=r"apt-get install libaravis-0\.8-0"):
            open_camera("genicam:")
    finally:
        aravis.load.cache_clear()
        aravis.library.cache_clear()


@installed
def test_twelve_megapixels_arrive_bit_exact():
    """Through the library's camera within the process, which sends nothing over a network."""
    frames = TwinFrames(Camera("thesis"), [np.full((3000, 4000), 50, np.float32)])
    with camera_within(frames, rate=10.0) as live:
        assert live.sensor == (3000, 4000)
        for _ in range(2):
            raw = live.read(timeout=60)
            np.testing.assert_array_equal(raw.frame, sent(frames, raw))


# --- vendors' producers -----------------------------------------------------------------------


@pytest.fixture
def demo_producer(monkeypatch):
    genicam = pytest.importorskip("genicam", reason="pip install 'squilla[genicam]'")
    pytest.importorskip("harvesters", reason="pip install 'squilla[genicam]'")
    folder = Path(genicam.__file__).parent
    if not (folder / "viky.cti").exists():
        pytest.skip("the installed package genicam ships no demo producer, viky.cti")
    monkeypatch.setenv(gentl.PATH, str(folder))


def test_a_camera_of_a_vendors_producer(demo_producer):
    sources = [info.source for info in gentl.cameras()]
    assert "gentl:VikyTL_DEV_red" in sources
    with open_camera("gentl:VikyTL_DEV_red") as camera:
        assert camera.format.name == "Mono8"
        for count, raw in enumerate(camera.frames()):
            assert raw.frame.shape == (400, 400)
            assert len(np.unique(raw.frame)) > 1  # a ball on a wall
            if count == 5:
                break
        camera.region = Region(200, 300)
        assert camera.read(timeout=PATIENCE).frame.shape == (200, 300)
        with pytest.raises(InputError, match="has no exposure"):
            camera.exposure = 5.0
        with pytest.raises(InputError, match="has no TriggerSource"):
            camera.trigger = "Line1"
        assert camera.read(timeout=PATIENCE).exposure is None
    with pytest.raises(InputError, match=r"no free GenTL camera 'other'.*VikyTL_DEV_green"):
        open_camera("gentl:other")


def test_no_producer_is_said(monkeypatch, tmp_path):
    pytest.importorskip("harvesters", reason="pip install 'squilla[genicam]'")
    monkeypatch.delenv(gentl.PATH, raising=False)
    with pytest.raises(InputError, match="No GenTL producer is known: GENICAM_GENTL64_PATH"):
        open_camera("gentl:")
    (tmp_path / "broken.cti").write_bytes(b"not a library")
    monkeypatch.setenv(gentl.PATH, str(tmp_path))
    with pytest.raises(InputError, match="cannot be loaded"):
        open_camera("gentl:")


def test_harvesters_missing_is_said(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "harvesters.core", None)
    with pytest.raises(InputError, match=r"pip install 'squilla\[genicam\]'"):
        open_camera("gentl:")


# --- commands ---------------------------------------------------------------------------------


@installed
def test_commands_list_and_grab(twin, frames, tmp_path):
    def run(*words):
        result = CliRunner().invoke(app, [str(word) for word in words])
        assert result.exit_code == 0, result.output
        return result.output

    listed = {row["source"]: row for row in json.loads(run("cameras", "--json"))}
    row = listed[f"genicam:squilla-twin-{frames.serial}"]
    assert (row["address"], row["serial"]) == ("127.0.0.1", frames.serial)
    assert "Mono12p" in row["formats"]
    said = run("grab", "--source", row["source"], "--count", 3, "--exposure", 6, "-o", tmp_path)
    assert "3 frames" in said
    raws = list(read_raws(tmp_path))
    assert len(raws) == 3
    for raw in raws:
        np.testing.assert_array_equal(raw.frame, sent(frames, raw))
    assert {raw.exposure for raw in raws} == {6.0}
