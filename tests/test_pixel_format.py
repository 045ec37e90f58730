"""Pixel formats against their definition, bit by bit, in plain Python on small frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from squilla.errors import InputError
from squilla.live.pixel_format import FORMATS, best_format, pixel_format

random = np.random.default_rng(0)


def stream(pixels: list[int], bits: int) -> bytes:
    """Lay pixels one after another, least significant bit first: PFNC's formats with a 'p'."""
    number = sum(pixel << bits * place for place, pixel in enumerate(pixels))
    return number.to_bytes(-(-bits * len(pixels) // 8), "little")


def older(pixels: list[int]) -> bytes:
    """Lay 12-bit pixels as GigE Vision's Mono12Packed: P0[11:4], P1[3:0] P0[3:0], P1[11:4]."""
    data = bytearray()
    for first, second in zip(pixels[::2], pixels[1::2], strict=True):
        data += bytes([first >> 4, (second & 15) << 4 | first & 15, second >> 4])
    return bytes(data)


DEFINITION = {
    "Mono8": lambda pixels: bytes(pixels),
    "Mono10": lambda pixels: b"".join(pixel.to_bytes(2, "little") for pixel in pixels),
    "Mono12": lambda pixels: b"".join(pixel.to_bytes(2, "little") for pixel in pixels),
    "Mono16": lambda pixels: b"".join(pixel.to_bytes(2, "little") for pixel in pixels),
    "Mono10p": lambda pixels: stream(pixels, 10),
    "Mono12p": lambda pixels: stream(pixels, 12),
    "Mono12Packed": older,
}


@pytest.mark.parametrize("name", FORMATS)
def test_as_defined(name):
    known = FORMATS[name]
    frame = random.integers(0, 2**known.bits, (6, 8), dtype=np.uint16)
    frame[0, :2] = 0, 2**known.bits - 1
    data = np.frombuffer(DEFINITION[name](frame.ravel().tolist()), np.uint8)
    assert known.bytes_for(frame.size) == len(data)
    np.testing.assert_array_equal(known.unpack(data, frame.shape), frame)
    packed = np.empty_like(data)
    known.pack(frame, packed)
    np.testing.assert_array_equal(packed, data)


@pytest.mark.parametrize("name", FORMATS)
def test_code_tells_the_bits_on_the_wire(name):
    """PFNC: bits 16 to 23 of a code are what one pixel takes, 0x01 on top means grey."""
    known = FORMATS[name]
    size, count = known.group
    assert known.code >> 16 & 0xFF == 8 * size / count
    assert known.code >> 24 == 1


@settings(deadline=None)  # the first run of a kernel compiles it
@given(st.sampled_from(list(FORMATS)), st.integers(1, 7), st.integers(1, 9))
def test_every_size_comes_back(name, rows, columns):
    known = FORMATS[name]
    frame = random.integers(0, 2**known.bits, (rows, columns), dtype=np.uint16)
    data = np.full(known.bytes_for(frame.size), 0xFF, np.uint8)
    known.pack(frame, data)
    np.testing.assert_array_equal(known.unpack(data, (rows, columns)), frame)
    followed = np.concatenate([data, np.full(300, 0xAB, np.uint8)])
    np.testing.assert_array_equal(known.unpack(followed, (rows, columns)), frame)


def test_rows_that_start_on_a_byte():
    """Three 12-bit pixels are 4.5 bytes: a camera may fill every row up to five."""
    frame = random.integers(0, 4096, (4, 3), dtype=np.uint16)
    rows = b"".join(stream(row, 12) for row in frame.tolist())
    assert len(rows) == 20
    data = np.frombuffer(rows, np.uint8)
    np.testing.assert_array_equal(FORMATS["Mono12p"].unpack(data, frame.shape), frame)


def test_too_few_bytes_are_refused():
    with pytest.raises(InputError, match="17 bytes, but 3 x 4 pixels of Mono12p are 18"):
        FORMATS["Mono12p"].unpack(np.zeros(17, np.uint8), (3, 4))


def test_the_deepest_and_shortest_is_taken():
    assert best_format(["Mono8", "Mono16", "Mono12p", "Mono12"]).name == "Mono12p"
    assert best_format(["Mono8", "RGB8"]).name == "Mono8"
    with pytest.raises(InputError, match=r"BayerRG12, RGB8.*colour camera"):
        best_format(["BayerRG12", "RGB8"])
    with pytest.raises(InputError, match="'RGB8' cannot be used: squilla reads Mono12p"):
        pixel_format("RGB8")
