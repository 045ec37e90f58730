"""Every reader as a function of bytes: it may give a result or an InputError, and nothing else."""

import io
import json
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import tifffile

from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.calibration.lessons import read_sweep
from squilla.calibration.store import load_calibration
from squilla.camera.design import CameraDesign
from squilla.errors import InputError
from squilla.files.cube import labelled, load_cube, read_scene, save
from squilla.files.depth import read_depth
from squilla.files.journal import Journal
from squilla.files.raw import Raw, list_frames, read_raw, write_raw
from squilla.optics.filters import StencilRecipe, read_filters
from squilla.optics.materials import refractive_index
from squilla.reconstruction.models import load_model, model_class

CORPUS = Path(__file__).parent / "corpus"
WAVELENGTH = np.array([500.0, 550.0, 600.0, 650.0, 750.0])


@dataclass(frozen=True)
class Target:
    """A reader under test.

    name : of the file that the bytes become.
    read : called with its path.
    seeds : whole files to start from.
    beside : further files that stand beside it.
    """

    name: str
    read: Callable[[Path], object]
    seeds: Callable[[], list[bytes]]
    beside: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)


def run(target: Target, data: bytes, folder: Path) -> bool:
    """Let a reader read bytes; return whether it took them. Anything but InputError passes on."""
    for name, content in target.beside.items():
        if not (folder / name).exists():
            (folder / name).write_bytes(content())
    path = folder / target.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            target.read(path)
        except InputError as error:
            if not str(error).strip():
                raise RuntimeError("an InputError without a sentence") from error
            return False
    return True


# --- seeds --------------------------------------------------------------------------------------


def _written(name: str, write: Callable[[Path], object], of: str | None = None) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / (of or name)).read_bytes()


_FRAME = np.arange(12, dtype=np.uint16).reshape(3, 4)


def _raws(suffix: str, of: str | None = None) -> Callable[[], list[bytes]]:
    raw = Raw(_FRAME, 2.5, {"camera": "a"})
    return lambda: [_written(f"f{suffix}", lambda path: write_raw(path, raw), of)]


def _film() -> list[bytes]:
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.stack([_FRAME, _FRAME]), photometric="minisblack")
    packed = io.BytesIO()
    tifffile.imwrite(packed, _FRAME, compression="zlib", tile=(16, 16))
    return [stream.getvalue(), packed.getvalue(), *_raws(".tiff")()]


def _cube():
    values = np.linspace(0, 1, 2 * 3 * 5, dtype=np.float32).reshape(2, 3, 5)
    return labelled(values, WAVELENGTH, attributes={"note": "x", "snr": 20.0})


def _cubes(suffix: str, of: str | None = None) -> Callable[[], list[bytes]]:
    return lambda: [_written(f"f{suffix}", lambda path: save(_cube(), path), of)]


def _saved(save_array: Callable, *args, **named) -> bytes:
    stream = io.BytesIO()
    save_array(stream, *args, **named)
    return stream.getvalue()


def _npz() -> list[bytes]:
    return [
        _saved(np.savez, cube=_cube().values, wavelength=WAVELENGTH),
        _saved(np.savez_compressed, cube=_cube().values, wavelength=WAVELENGTH),
    ]


def _mat() -> list[bytes]:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, {"cube": _cube().values, "wavelength": WAVELENGTH}, do_compression=True)
    return [stream.getvalue()]


@cache
def small_calibration() -> Calibration:
    """Return a calibration of two units with all its parts."""
    response = 0.5 + 0.3 * np.cos(np.arange(2)[:, None] * WAVELENGTH / 40)
    lattice = Lattice(
        (1, 2), np.array([[3.5, 3.5], [3.5, 11.5]]), np.array([[0.0, 0.0], [0.0, 1.0]]),
        0, (4, 4), 100.0, 8.0, 7.4, 300.0,
    )  # fmt: skip
    plane = np.ones((8, 16), np.float32)
    pixels = Pixels(64 * plane, 0 * plane, plane, plane > 0, 4000.0, 2.7, 2.5)
    return Calibration(
        WAVELENGTH, np.stack([response, 0.9 * response]), np.array([0.0, 0.1]), lattice, pixels,
        provenance={"camera": "a"},
    )  # fmt: skip


@cache
def _bare() -> Calibration:
    response = 0.5 + 0.3 * np.cos(np.arange(4)[:, None] * np.linspace(500, 750, 26) / 40)
    return Calibration.from_sensitivity(response, np.linspace(500, 750, 26))


def _model() -> list[bytes]:
    from safetensors.torch import load, save

    model = model_class("mlp")(_bare())
    whole = _written("m.safetensors", model.save)
    size = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + size])
    tensors = load(whole)
    few = {"sensitivity": tensors["sensitivity"], "wavelength": tensors["wavelength"]}
    return [save(few, header["__metadata__"])]  # 4 MB of weights are no seed


def _zarr(name: str) -> Callable[[], bytes]:
    def content() -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            save(_cube(), Path(folder) / "f.zarr")
            return (Path(folder) / name).read_bytes()

    return content


def _text(*lines: str) -> Callable[[], list[bytes]]:
    return lambda: ["\n".join(lines).encode()]


def _journal(path: Path) -> None:
    with Journal(path, {"model": "ridge"}):
        pass


def _frames(path: Path) -> None:
    for frame in list_frames(path):
        frame.read()


def _toml_design() -> list[bytes]:
    from squilla.camera.design import design_path

    return [design_path("thesis").read_bytes(), design_path("mosaic-16").read_bytes()]


def _toml_filters() -> list[bytes]:
    array = StencilRecipe(filters=2).draw(0)
    return [_written("f.toml", array.save)]


_MATRIX = np.stack([WAVELENGTH, *np.linspace(0.1, 0.9, 10).reshape(2, 5)], -1)
_CSV = "wavelength,a,b\n" + "\n".join(",".join(f"{v:g}" for v in row) for row in _MATRIX)
_NK = "wl,n\n400,1.5\n500,1.49\n800,1.47\n"
_YAML = """DATA:
  - type: formula 1
    wavelength_range: 0.3 1.0
    coefficients: 0 1.3 0.01 0.2 0.02
  - type: tabulated k
    data: |
      0.3 0.0
      1.0 0.1
"""


def _npz_filters() -> list[bytes]:
    return [_saved(np.savez, values=_MATRIX[:, 1:].T.copy(), wavelength=WAVELENGTH)]


def _mat_filters() -> list[bytes]:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, {"values": _MATRIX[:, 1:].T, "wavelength": WAVELENGTH}, do_compression=True)
    return [stream.getvalue()]


def _zarr_part(part: str) -> Target:
    return Target(
        f"f.zarr/{part}",
        lambda path: load_cube(next(p for p in path.parents if p.suffix == ".zarr")),
        lambda: [_zarr(f"f.zarr/{part}")()],
    )


TARGETS: dict[str, Target] = {
    "raw-tiff": Target("f.tiff", _frames, _film),
    "raw-png": Target("f.png", read_raw, _raws(".png")),
    "raw-npy": Target("f.npy", read_raw, _raws(".npy")),
    "raw-json": Target("f.json", lambda p: read_raw(p.with_suffix(".raw")), _raws(".raw", "f.json"),
                       {"f.raw": lambda: _raws(".raw")()[0]}),
    "cube-envi": Target("f.hdr", load_cube, _cubes(".hdr"),
                        {"f.img": lambda: _cubes(".hdr", "f.img")()[0]}),
    "cube-tiff": Target("f.tiff", load_cube, _cubes(".tiff")),
    "cube-netcdf": Target("f.nc", load_cube, _cubes(".nc")),
    "cube-zarr": _zarr_part("radiance/zarr.json"),
    "cube-zarr-group": _zarr_part("zarr.json"),
    "cube-zarr-chunk": _zarr_part("radiance/c/0/0/0"),
    "scene-npz": Target("f.npz", read_scene, _npz),
    "scene-npy": Target("f.npy", lambda p: read_scene(p, wavelength=WAVELENGTH),
                        lambda: [_saved(np.save, _cube().values)]),
    "scene-mat": Target("f.mat", read_scene, _mat),
    "calibration": Target("f.nc", load_calibration,
                          lambda: [_written("f.nc", small_calibration().save)]),
    "model": Target("f.safetensors", lambda p: load_model(p, _bare()), _model),
    "camera-toml": Target("f.toml", CameraDesign.load, _toml_design),
    "filters-toml": Target("f.toml", read_filters, _toml_filters),
    "filters-csv": Target("f.csv", read_filters, _text(_CSV)),
    "filters-npz": Target("f.npz", read_filters, _npz_filters),
    "filters-mat": Target("f.mat", read_filters, _mat_filters),
    "material-csv": Target("f.csv", lambda p: refractive_index(p, 600.0), _text(_NK)),
    "material-yaml": Target("f.yml", lambda p: refractive_index(p, 600.0), _text(_YAML)),
    "sweep-csv": Target("sweep.csv", lambda p: list(read_sweep(p.parent)),
                        _text("file,wavelength,power,bandwidth", "a.npy,500,1,4"),
                        {"a.npy": lambda: _raws(".npy")()[0]}),
    "depth-tiff": Target("f.tiff", lambda p: read_depth(p, (3, 3)), _film),
    "journal": Target("f.jsonl", _journal,
                      _text('{"recipe": {"model": "ridge"}}', '{"name": "a", "snr": 20}', "")),
}  # fmt: skip


def prepare(target: Target, folder: Path) -> None:
    """Lay out what a target needs around its file."""
    if ".zarr/" in target.name:
        save(_cube(), folder / "f.zarr")
