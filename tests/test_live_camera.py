"""What a live camera makes of its connection's moods: counts, numbers, losses; no network."""

import numpy as np
import pytest

from squilla.errors import InputError
from squilla.live.connection import Arrival, CameraInfo, CameraLost, Region, Statistics
from squilla.live.genicam import LiveCamera
from squilla.live.pixel_format import FORMATS


class Scripted:
    """A connection that hands out what it is told, each item for one call of `receive`.

    An item is a frame's number, any negative one for an incomplete frame, None for silence, or an
    error to raise.
    """

    buffers = 4
    info = CameraInfo("test:", "Maker", "Eye", "77")
    sensor = Region(2, 4)
    exposures, gains = (1.0, 100.0), (0.0, 10.0)

    def __init__(self, script, formats=("Mono8", "Mono12p")):
        self.script, self.formats = list(script), list(formats)
        self.exposure, self.gain, self.region = 10.0, 0.0, self.sensor
        self.lent, self.closed, self.living, self.code = 0, False, True, FORMATS["Mono12p"].code

    def __getattr__(self, name):
        if name.startswith("set_"):
            return lambda value: setattr(self, name.removeprefix("set_"), value)
        raise AttributeError(name)

    def start(self): ...
    def stop(self): ...

    def alive(self):
        return self.living

    def close(self):
        self.closed = True

    def receive(self, timeout):
        item = self.script.pop(0) if self.script else None
        if isinstance(item, Exception):
            raise item
        if item is None:
            return None
        self.lent += 1
        data = np.full(12, abs(item) % 256, np.uint8)
        return Arrival(
            item > 0, item if item > 0 else None, 0, self.code, (2, 4), data, self.release
        )

    def release(self):
        self.lent -= 1


def opened(*connections, patience=0.0, said=None):
    queue = list(connections)
    report = None if said is None else said.append
    return LiveCamera(lambda: queue.pop(0), None, patience, report)


def read(script, count=1):
    """Return the numbers of the frames read, and the statistics."""
    connection = Scripted(script)
    camera = opened(connection)
    numbers = [camera.read().metadata["frame"] for _ in range(count)]
    assert connection.lent == 0  # each buffer went back
    return numbers, camera.statistics


def test_the_newest_of_several():
    numbers, counts = read([5, 6, 7, None])
    assert numbers == [7]
    assert counts == Statistics(delivered=1, skipped=2)


def test_gaps_are_counted():
    numbers, counts = read([5, None, 9, None], 2)
    assert numbers == [5, 9]
    assert counts == Statistics(delivered=2, lost=3)


@pytest.mark.parametrize(
    ("script", "lost"),
    [
        ([65534, None, 65535, None, 1, None], 0),  # GigE Vision knows no frame 0
        ([65534, None, 65535, None, 3, None], 2),
        ([65535, None, 65536, None, 65538, None], 1),  # cameras with longer numbers go on
    ],
)
def test_numbers_begin_anew(script, lost):
    assert read(script, 3)[1] == Statistics(delivered=3, lost=lost)


def test_incomplete_frames_have_lost_their_numbers():
    """Each stands for the one after the last; what the next number leaves over was never seen."""
    numbers, counts = read([-9, 4, None, -9, -9, None, 9, None], 2)
    assert numbers == [4, 9]
    assert counts == Statistics(delivered=2, incomplete=3, lost=2)
    assert read([65535, None, -9, 2, None], 2)[1].lost == 0


def test_frames_that_waited_too_long_are_not_shown():
    """All four buffers full: the camera has sent newer ones that found no place."""
    numbers, counts = read([1, 2, 3, 4, None, None, 20, None], 1)
    assert numbers == [20]
    assert counts == Statistics(delivered=1, skipped=4, lost=15)


def test_only_incomplete_frames():
    camera = opened(Scripted([-n for n in range(1, 400)]))
    with pytest.raises(InputError, match=r"sends, but all .* had lost packets"):
        camera.read(timeout=0.05)


def test_silence(monkeypatch):
    with pytest.raises(InputError, match=r"answers but sent no frame in 0\.05 s"):
        opened(Scripted([])).read(timeout=0.05)


def test_another_format_in_mid_stream():
    connection = Scripted([1])
    connection.code = FORMATS["Mono8"].code
    with pytest.raises(InputError, match="sends Mono8 although Mono12p was set"):
        opened(connection).read()
    assert connection.lent == 0


def test_a_colour_camera():
    with pytest.raises(InputError, match=r"RGB8.*A colour camera cannot be used"):
        opened(Scripted([], formats=["RGB8"]))


def test_a_lost_camera_comes_back_as_it_was():
    said = []
    first, second = Scripted([8, None, CameraLost("Gone.")]), Scripted([1, None])
    camera = opened(first, second, patience=5, said=said)
    camera.exposure, camera.gain = 33.0, 2.0
    assert [camera.read().metadata["frame"] for _ in range(2)] == [8, 1]
    assert first.closed
    assert (second.exposure, second.gain) == (33.0, 2.0)
    assert camera.statistics == Statistics(delivered=2, reconnected=1)
    assert said[0].startswith("Gone. Looking for it for 5 s")
    assert said[1].startswith("The camera Maker Eye 77 is back after")


def test_a_camera_that_stays_away():
    def connect():
        if found:
            return found.pop()
        raise InputError("Nobody there.")

    found = [Scripted([CameraLost("Gone.")])]
    camera = LiveCamera(connect, None, 0.5, None)
    with pytest.raises(CameraLost, match=r"not come back within 0\.5 s; .*Nobody there"):
        camera.read()
    found.append(Scripted([7]))  # whoever asks again gets another chance
    assert camera.read().metadata["frame"] == 7


def test_what_is_set_while_a_camera_is_away_is_set_when_it_is_back():
    first, second = Scripted([CameraLost("Gone.")]), Scripted([1])
    camera = opened(first, second, patience=5)
    camera.report = lambda said: setattr(camera, "exposure", 44.0) if "Gone" in said else None
    assert camera.read().exposure == 44.0
    assert first.exposure == 10.0


def test_a_refusal_of_a_dead_camera_is_a_loss():
    first, second = Scripted([]), Scripted([1])
    first.start = lambda: (_ for _ in ()).throw(InputError("no stream channel"))
    first.living = False
    assert opened(first, second, patience=5).read().metadata["frame"] == 1
    first.living = True
    with pytest.raises(InputError, match="no stream channel"):
        opened(first).read()


def test_a_refused_setting_is_forgotten():
    first, second = Scripted([CameraLost("Gone.")]), Scripted([1])
    first.set_gain = lambda value: (_ for _ in ()).throw(InputError("not while it rains"))
    camera = opened(first, second, patience=5)
    with pytest.raises(InputError, match="rains"):
        camera.gain = 3.0
    assert camera.read().metadata["gain"] == 0.0


def test_a_camera_without_exposure():
    connection = Scripted([1])
    connection.exposures = connection.exposure = None
    camera = opened(connection)
    with pytest.raises(InputError, match="has no exposure to set"):
        camera.exposure = 5.0
    assert camera.read().exposure is None
