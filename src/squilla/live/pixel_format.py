"""How cameras lay grey pixels on the wire, and how they become whole numbers again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba
import numpy as np

from squilla.errors import InputError

Kernel = Callable[[np.ndarray, np.ndarray], None]
"""Turns whole groups of one array into those of another, (bytes,) and (pixels,) or the reverse."""


@dataclass(frozen=True)
class PixelFormat:
    """One layout of grey pixels.

    name, code : as the GenICam pixel format naming convention has them.
    bits : depth of a pixel; DN run from 0 to 2^bits - 1.
    group : (bytes, pixels) of the smallest piece that stands for itself.
    decode, encode : kernels for whole groups.

    Source: EMVA, GenICam Pixel Format Naming Convention (PFNC) 2.4; for the formats "Packed",
    GigE Vision 2.0, section 26.
    """

    name: str
    code: int
    bits: int
    group: tuple[int, int]
    decode: Kernel
    encode: Kernel

    def bytes_for(self, pixels: int) -> int:
        """Return how many bytes so many pixels take, the last one filled up."""
        size, count = self.group
        return -(-pixels * size // count)

    def unpack(self, data: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Return the pixels of a frame.

        Parameters
        ----------
        data : array, (bytes,) uint8
            What the camera sent: all pixels in one stream, and what follows is left alone; or
            exactly so many bytes that each row starts on its own.
        shape : (rows, columns)

        Returns
        -------
        array, (rows, columns) uint16, DN

        Raises
        ------
        InputError
            If there are too few bytes.
        """
        rows, columns = shape
        stream, row = self.bytes_for(rows * columns), self.bytes_for(columns)
        if len(data) < stream:
            raise InputError(
                f"The camera sent {len(data):,} bytes, but {rows} x {columns} pixels of "
                f"{self.name} are {stream:,}; set its region or pixel format anew."
            )
        if stream < len(data) == rows * row:
            return np.stack([self._pixels(line, columns) for line in data.reshape(rows, row)])
        return self._pixels(data[:stream], rows * columns).reshape(shape)

    def _pixels(self, data: np.ndarray, count: int) -> np.ndarray:
        size, each = self.group
        groups = -(-count // each)
        if groups * size > len(data):  # the last group is cut short
            data = np.concatenate([data, np.zeros(groups * size - len(data), np.uint8)])
        pixels = np.empty(groups * each, np.uint16)
        self.decode(data, pixels)
        return pixels[:count]

    def pack(self, frame: np.ndarray, data: np.ndarray) -> None:
        """Write a frame as one stream of pixels; the reverse of `unpack`.

        Parameters
        ----------
        frame : array, (rows, columns) uint16
            DN, none larger than the format holds.
        data : array, (bytes,) uint8
            Filled; of the length that `bytes_for` tells.
        """
        size, each = self.group
        whole = frame.size // each
        pixels = frame.reshape(-1)
        self.encode(pixels[: whole * each], data[: whole * size])
        if whole * each < frame.size:
            last, rest = np.zeros(each, np.uint16), np.empty(size, np.uint8)
            last[: frame.size - whole * each] = pixels[whole * each :]
            self.encode(last, rest)
            data[whole * size :] = rest[: len(data) - whole * size]


# --- kernels; one core keeps up with the memory, so they are not parallel ----------------------


def _decode_8(data, pixels):
    pixels[:] = data


def _encode_8(pixels, data):
    data[:] = pixels


def _decode_16(data, pixels):
    pixels[:] = data.view("<u2")


def _encode_16(pixels, data):
    data.view("<u2")[:] = pixels


@numba.njit(cache=True, nogil=True)
def _decode_12p(data, pixels):
    for group in range(len(pixels) // 2):
        a, b, c = data[3 * group], data[3 * group + 1], data[3 * group + 2]
        pixels[2 * group] = a | (b & 0xF) << 8
        pixels[2 * group + 1] = b >> 4 | c << 4


@numba.njit(cache=True, nogil=True)
def _encode_12p(pixels, data):
    for group in range(len(pixels) // 2):
        first, second = pixels[2 * group], pixels[2 * group + 1]
        data[3 * group] = first & 0xFF
        data[3 * group + 1] = first >> 8 | (second & 0xF) << 4
        data[3 * group + 2] = second >> 4


# The older "Packed" layout: the upper eight bits of both pixels stand whole, their lower bits
# share the byte between.


@numba.njit(cache=True, nogil=True)
def _decode_12_packed(data, pixels):
    for group in range(len(pixels) // 2):
        a, b, c = data[3 * group], data[3 * group + 1], data[3 * group + 2]
        pixels[2 * group] = a << 4 | b & 0xF
        pixels[2 * group + 1] = c << 4 | b >> 4


@numba.njit(cache=True, nogil=True)
def _encode_12_packed(pixels, data):
    for group in range(len(pixels) // 2):
        first, second = pixels[2 * group], pixels[2 * group + 1]
        data[3 * group] = first >> 4
        data[3 * group + 1] = first & 0xF | (second & 0xF) << 4
        data[3 * group + 2] = second >> 4


@numba.njit(cache=True, nogil=True)
def _decode_10p(data, pixels):
    for group in range(len(pixels) // 4):
        at = 5 * group
        a, b, c, d, e = data[at], data[at + 1], data[at + 2], data[at + 3], data[at + 4]
        pixels[4 * group] = a | (b & 0x3) << 8
        pixels[4 * group + 1] = b >> 2 | (c & 0xF) << 6
        pixels[4 * group + 2] = c >> 4 | (d & 0x3F) << 4
        pixels[4 * group + 3] = d >> 6 | e << 2


@numba.njit(cache=True, nogil=True)
def _encode_10p(pixels, data):
    for group in range(len(pixels) // 4):
        at = 4 * group
        a, b, c, d = pixels[at], pixels[at + 1], pixels[at + 2], pixels[at + 3]
        data[5 * group] = a & 0xFF
        data[5 * group + 1] = a >> 8 | (b & 0x3F) << 2
        data[5 * group + 2] = b >> 6 | (c & 0xF) << 4
        data[5 * group + 3] = c >> 4 | (d & 0x3) << 6
        data[5 * group + 4] = d >> 2


FORMATS = {
    known.name: known
    for known in (
        PixelFormat("Mono12p", 0x010C0047, 12, (3, 2), _decode_12p, _encode_12p),
        PixelFormat("Mono12Packed", 0x010C0006, 12, (3, 2), _decode_12_packed, _encode_12_packed),
        PixelFormat("Mono12", 0x01100005, 12, (2, 1), _decode_16, _encode_16),
        PixelFormat("Mono16", 0x01100007, 16, (2, 1), _decode_16, _encode_16),
        PixelFormat("Mono10p", 0x010A0046, 10, (5, 4), _decode_10p, _encode_10p),
        PixelFormat("Mono10", 0x01100003, 10, (2, 1), _decode_16, _encode_16),
        PixelFormat("Mono8", 0x01080001, 8, (1, 1), _decode_8, _encode_8),
    )
}
"""By name, the one to take first where a camera has several: 12 bits, with the least to send."""


def pixel_format(name: str) -> PixelFormat:
    """Return a format by its name; InputError where squilla cannot read it."""
    if name not in FORMATS:
        raise InputError(
            f"The pixel format {name!r} cannot be used: squilla reads {', '.join(FORMATS)}."
        )
    return FORMATS[name]


def best_format(offered: Sequence[str]) -> PixelFormat:
    """Return the format to take of those that a camera offers.

    Raises
    ------
    InputError
        If none is grey and plain: the camera is then a colour camera, or compresses.
    """
    for name, known in FORMATS.items():
        if name in offered:
            return known
    raise InputError(
        f"The camera offers {', '.join(offered) or 'no pixel format'}; squilla needs a grey one: "
        f"{', '.join(FORMATS)}. A colour camera cannot be used."
    )
