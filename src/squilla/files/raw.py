"""Raw frames: what the sensor said, untouched, with its exposure."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from squilla.errors import InputError
from squilla.files.disk import check_size, existing, reading, replacing
from squilla.files.tiff import opened, read_page


@dataclass(frozen=True, eq=False)
class Raw:
    """One raw frame.

    frame : (rows, columns) uint16, DN.
    exposure : ms; None if unknown.
    metadata : whatever else is known; plain numbers, strings, lists and dicts.
    """

    frame: np.ndarray
    exposure: float | None = None
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if self.frame.ndim != 2 or self.frame.dtype != np.uint16 or self.frame.size == 0:
            raise InputError(
                "A raw frame is one grey picture, (rows, columns) of uint16; this one is "
                f"{self.frame.shape} of {self.frame.dtype}."
            )
        if self.exposure is not None and not 0 <= self.exposure < np.inf:
            raise InputError(f"The exposure must be a time in ms, not {self.exposure}.")


@dataclass(frozen=True)
class Frame:
    """Where one raw frame is: a file, and for a TIFF of several pages which of them, from 0."""

    path: Path
    page: int | None = None

    @property
    def name(self) -> str:
        """The file's name without its suffix, and the number of the page."""
        return self.path.stem + ("" if self.page is None else f"-{self.page:05d}")

    def read(self) -> Raw:
        """Read the frame; errors as in `read_raw`."""
        if self.page is None:
            return read_raw(self.path)
        with opened(self.path) as tiff:
            page = tiff.pages[self.page]
            frame, facts = read_page(self.path, page), _described(getattr(page, "description", ""))
        return _raw(self.path, frame, facts)


def list_frames(path: str | Path) -> list[Frame]:
    """Return the frames of a file, or of a folder in the order of its names, without reading them.

    Raises
    ------
    InputError
        If nothing is there or a file cannot be a raw frame.
    """
    files = _files(existing(path))
    return [frame for file in files for frame in _pages(file)]


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        # Hidden ones are other programs' notes, or frames that are still being written.
        seen = (file for file in path.iterdir() if not file.name.startswith("."))
        inside = [file for file in seen if file.suffix.lower() in _READERS]
        if not inside:
            raise InputError(f"The folder {path} holds no raw frame ({', '.join(_READERS)}).")
        return sorted(inside, key=_natural)
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{path} is none of the raw frames known: {', '.join(_READERS)}.")
    return [path]


def _pages(path: Path) -> list[Frame]:
    if path.suffix.lower() in (".tif", ".tiff"):
        with opened(path) as tiff:
            count = len(tiff.pages)
        if count > 1:
            return [Frame(path, page) for page in range(count)]
    return [Frame(path)]


def read_raw(path: str | Path) -> Raw:
    """Read one raw frame: TIFF, PNG, NPY, or .raw with a JSON file beside it.

    A file ``frame.json`` beside ``frame.png`` tells the exposure, ``{"exposure": 12.5}`` in ms,
    where the picture itself does not; other keys become metadata. For ``frame.raw`` it must tell
    "rows" and "columns" too, and may tell "dtype" (uint8 or uint16) and "byte_order" (little or
    big).

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind, or holds several frames or colours.
    """
    if Path(path).is_dir():
        raise InputError(f"{path} is a folder; give one file, or use read_raws for all of them.")
    raws = read_raws(path)
    raw = next(raws)
    if next(raws, None) is not None:
        raise InputError(f"{path} holds several frames; use read_raws, which goes through them.")
    return raw


def read_raws(path: str | Path) -> Iterator[Raw]:
    """Go through the frames of a multi-page TIFF, or of a folder in the order of its names.

    One frame at a time is held in memory. Parameters and errors as in `read_raw`.
    """
    for file in _files(existing(path)):
        for frame, facts in _READERS[file.suffix.lower()](file):
            yield _raw(file, frame, facts)


def _raw(path: Path, frame: np.ndarray, facts: dict[str, Any]) -> Raw:
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{path} holds {frame.shape} of {frame.dtype}; a raw frame is one grey picture of "
            "8 or 16-bit whole numbers, as the sensor gave it."
        )
    return Raw(frame.astype(np.uint16, copy=False), *_facts(path, facts or _sidecar(path)))


def write_raw(path: str | Path, raw: Raw) -> None:
    """Write a raw frame as its suffix says: .tiff, .png, .npy or .raw.

    A TIFF carries its exposure and metadata itself; the others get a JSON file beside them, as
    `read_raw` describes.

    Parameters
    ----------
    path : str or Path
    raw : Raw

    Raises
    ------
    InputError
        If the suffix is unknown, the place cannot be written, or the metadata is not plain.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    facts: dict[str, Any] = {"exposure": raw.exposure, "metadata": raw.metadata}
    if suffix in (".tif", ".tiff"):
        import tifffile

        description = _json(facts)
        with replacing(path) as temporary:
            tifffile.imwrite(temporary, raw.frame, description=description, metadata=None)
        return
    if suffix == ".raw":
        rows, columns = raw.frame.shape
        facts |= {"rows": rows, "columns": columns, "dtype": "uint16", "byte_order": "little"}
    text = _json(facts)
    with replacing(path) as temporary:
        if suffix == ".png":
            from PIL import Image

            Image.fromarray(raw.frame).save(temporary, compress_level=1)
        elif suffix == ".npy":
            np.save(temporary, raw.frame)
        elif suffix == ".raw":
            raw.frame.astype("<u2", copy=False).tofile(temporary)
        else:
            raise InputError(f"{path} is none of the raw frames known: {', '.join(_READERS)}.")
    with replacing(path.with_suffix(".json")) as temporary:
        temporary.write_text(text + "\n")


# --- one reader for each kind: each yields (frame, what the file itself tells) -----------------


def _read_tiff(path: Path) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    with opened(path) as tiff:
        if not len(tiff.pages):
            raise InputError(f"{path} holds no picture; it may be cut short.")
        for page in tiff.pages:
            yield read_page(path, page), _described(getattr(page, "description", ""))


def _described(description: str) -> dict[str, Any]:
    """Return what a TIFF description tells if it is ours, else nothing."""
    try:
        facts = json.loads(description)
    except ValueError:
        return {}
    ours = isinstance(facts, dict) and {"exposure", "metadata"} <= set(facts)
    return facts if ours else {}


def _read_png(path: Path) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    from PIL import Image

    with reading(path, "PNG"), Image.open(path, formats=["PNG"]) as image:
        check_size(path, 2 * image.width * image.height)
        frame = np.array(image)  # a copy, for Pillow's own memory is read-only
    if image.mode == "I":  # some versions of Pillow widen 16-bit grey to 32 bits
        frame = frame.astype(np.uint16)
    yield frame, {}


def _read_npy(path: Path) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    with reading(path, "NPY"):
        frame = np.load(path, mmap_mode="r", allow_pickle=False)  # refuses a file too short
    if frame.dtype == np.dtype(">u2"):
        frame = frame.astype(np.uint16)
    yield np.array(frame), {}


def _read_binary(path: Path) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    facts = _sidecar(path)
    rows, columns = facts.get("rows"), facts.get("columns")
    if not (isinstance(rows, int) and isinstance(columns, int) and rows > 0 and columns > 0):
        raise InputError(
            f"{path} needs a file {path.with_suffix('.json').name} beside it that tells its "
            '"rows" and "columns".'
        )
    kinds = {"uint8": "u1", "uint16": "u2"}
    orders = {"little": "<", "big": ">"}
    kind, order = facts.get("dtype", "uint16"), facts.get("byte_order", "little")
    if kind not in kinds or order not in orders:
        raise InputError(
            f"{path.with_suffix('.json')} tells dtype {kind!r} and byte order {order!r}; known are "
            f"{', '.join(kinds)} and {', '.join(orders)}."
        )
    dtype = np.dtype(orders[order] + kinds[kind])
    needed, held = rows * columns * dtype.itemsize, path.stat().st_size
    if needed != held:
        raise InputError(
            f"{path} is {held:,} bytes long, but {rows} x {columns} pixels of {kind} are "
            f"{needed:,}; check the numbers in its JSON file."
        )
    frame = np.fromfile(path, dtype).reshape(rows, columns)
    yield frame.astype(dtype.newbyteorder("="), copy=False), facts


_READERS = {
    ".tiff": _read_tiff,
    ".tif": _read_tiff,
    ".png": _read_png,
    ".npy": _read_npy,
    ".raw": _read_binary,
}


def _sidecar(path: Path) -> dict[str, Any]:
    """Return what the JSON file beside a frame tells; nothing if there is none."""
    beside = path.with_suffix(".json")
    if not beside.exists():
        return {}
    with reading(beside, "JSON"):
        facts = json.loads(beside.read_text())
    if not isinstance(facts, dict):
        raise InputError(f'{beside} must hold one JSON object, such as {{"exposure": 12.5}}.')
    return facts


def _facts(path: Path, facts: dict[str, Any]) -> tuple[float | None, dict[str, Any]]:
    """Split what was told of a frame into exposure and metadata."""
    exposure, metadata = facts.get("exposure"), facts.get("metadata", {})
    if isinstance(exposure, bool) or not isinstance(exposure, int | float | None):
        raise InputError(f"The exposure of {path} must be a number in ms, not {exposure!r}.")
    if not isinstance(metadata, dict):
        raise InputError(f"The metadata of {path} must be a JSON object, not {metadata!r}.")
    known = {"exposure", "metadata", "rows", "columns", "dtype", "byte_order"}
    others = {key: value for key, value in facts.items() if key not in known}
    return None if exposure is None else float(exposure), others | metadata


def _json(facts: dict[str, Any]) -> str:
    def plain(value):
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise InputError(
            f"Metadata must be plain numbers, strings, lists and dicts, not {type(value).__name__}."
        )

    return json.dumps(facts, default=plain)


def _natural(path: Path) -> list[tuple[bool, int, str]]:
    """Sort key that puts frame2 before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]
