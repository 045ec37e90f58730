"""What page and server say to each other.

The page sends JSON, one message at a time, each with a number of its own (``id``). The server
answers each with one binary message: four bytes, the length of a JSON header; the header, filled
up with spaces so that the numbers begin at a multiple of four; then float32 numbers, little endian,
in the shape that the header states. A header with ``error`` carries a sentence and no numbers.

A stored cube answers what it is asked. A live camera answers the same asks again for every new
frame (`Watch`), and waits until the page has said that it has shown them (`Acknowledge`).
"""

import json
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from squilla.errors import InputError

LARGEST = 1 << 20
"""Longest message that a page may send, bytes."""

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Pixel = Annotated[int, Field(ge=0, lt=1 << 24)]
_Spectrum = Annotated[list[_Number], Field(min_length=1, max_length=4096)]
Region = tuple[_Pixel, _Pixel, _Pixel, _Pixel]
"""Top, left, bottom, right, px; the last two are the first rows and columns outside."""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    id: Annotated[int, Field(ge=0, lt=1 << 53)] = 0


class Picture(_Message):
    """A picture of a cube: colour (three planes of linear sRGB), or one plane of numbers.

    band : number of the band, for "band" and for layers with bands.
    spectrum : what "angle" compares every pixel with.
    white : spectrum that "colour" shows as white.
    window : the part that is wanted; by default all.
    """

    ask: Literal["picture"] = "picture"
    source: Annotated[int, Field(ge=0, lt=1000)] = 0
    kind: Literal["colour", "band", "angle", "layer"]
    band: Annotated[int, Field(ge=0, lt=1 << 16)] = 0
    layer: Annotated[str, Field(max_length=200)] = ""
    spectrum: _Spectrum | None = None
    white: _Spectrum | None = None
    window: Region | None = None


class Spectra(_Message):
    """Mean and standard deviation over regions, of a cube or of a layer with bands."""

    ask: Literal["spectra"] = "spectra"
    source: Annotated[int, Field(ge=0, lt=1000)] = 0
    regions: Annotated[list[Region], Field(min_length=1, max_length=32)]
    layer: Annotated[str, Field(max_length=200)] = ""


class Reference(_Message):
    """The text of a file with reference spectra; the answer is what it holds."""

    ask: Literal["reference"]
    name: Annotated[str, Field(max_length=200)]
    text: Annotated[str, Field(max_length=LARGEST)]


class Watch(_Message):
    """What shall be answered again for every newer frame of a live source."""

    ask: Literal["watch"]
    source: Annotated[int, Field(ge=0, lt=1000)] = 0
    wanted: Annotated[list[Picture | Spectra], Field(max_length=8)]


class Acknowledge(_Message):
    """All answers for a frame are shown; the next may come."""

    ask: Literal["acknowledge"]
    frame: Annotated[int, Field(ge=0)]


class Control(_Message):
    """A wish to a live source: exposure (ms), automatic exposure, gain, frozen, step, recording."""

    ask: Literal["control"]
    source: Annotated[int, Field(ge=0, lt=1000)] = 0
    name: Literal["exposure", "automatic", "gain", "frozen", "step", "recording"]
    value: _Number | bool | None = None


Message = Picture | Spectra | Reference | Watch | Acknowledge | Control
_READER = TypeAdapter(Annotated[Message, Field(discriminator="ask")])


def read_message(text: str) -> Message:
    """Return the message that a text holds, or raise InputError if it holds none."""
    try:
        return _READER.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(each) for each in first["loc"])
        raise InputError(f"The message was not understood: {place} {first['msg']}.") from None


def pack(header: dict[str, Any], values: np.ndarray | None = None) -> bytes:
    """Return the binary answer of a header and its numbers."""
    numbers = b""
    if values is not None:
        header = header | {"shape": list(values.shape)}
        numbers = np.ascontiguousarray(values, "<f4").tobytes()
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return len(text).to_bytes(4, "little") + text + numbers
