"""Raw frames on disk: every kind there and back, as others write and read them."""

import json
import tracemalloc

import numpy as np
import pytest

from squilla.errors import InputError
from squilla.files.raw import Raw, read_raw, read_raws, write_raw

RAW_SUFFIXES = [".tiff", ".png", ".npy", ".raw"]


@pytest.fixture
def frame() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 65536, (30, 41), dtype=np.uint16)


@pytest.mark.parametrize("suffix", RAW_SUFFIXES)
def test_raw_there_and_back(tmp_path, frame, suffix):
    told = {"gain": np.float32(1.5), "shape": [6, 6], "deep": {"note": "µm"}}
    write_raw(tmp_path / f"frame{suffix}", Raw(frame, 12.5, told))
    back = read_raw(tmp_path / f"frame{suffix}")
    assert back.frame.dtype == np.uint16
    np.testing.assert_array_equal(back.frame, frame)
    assert back.exposure == 12.5
    assert back.metadata == {"gain": 1.5, "shape": [6, 6], "deep": {"note": "µm"}}


@pytest.mark.parametrize("suffix", RAW_SUFFIXES)
def test_raw_without_exposure(tmp_path, frame, suffix):
    write_raw(tmp_path / f"frame{suffix}", Raw(frame))
    back = read_raw(tmp_path / f"frame{suffix}")
    assert back.exposure is None
    assert back.metadata == {}


def test_others_read_our_raw_frames(tmp_path, frame):
    """Pillow and NumPy, which know nothing of us, see the same numbers."""
    from PIL import Image

    for suffix in (".tiff", ".png"):
        write_raw(tmp_path / f"frame{suffix}", Raw(frame, 3.0))
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / f"frame{suffix}")), frame)
    write_raw(tmp_path / "frame.raw", Raw(frame, 3.0))
    flat = np.frombuffer((tmp_path / "frame.raw").read_bytes(), "<u2")
    np.testing.assert_array_equal(flat.reshape(frame.shape), frame)


def test_sidecar_tells_exposure_of_others_frames(tmp_path, frame):
    import tifffile
    from PIL import Image

    tifffile.imwrite(tmp_path / "a.tif", frame)
    Image.fromarray(frame).save(tmp_path / "b.png")
    np.save(tmp_path / "c.npy", frame.astype(">u2"))
    for name in ("a.tif", "b.png", "c.npy"):
        (tmp_path / name).with_suffix(".json").write_text('{"exposure": 8, "camera": "IMX226"}')
        raw = read_raw(tmp_path / name)
        np.testing.assert_array_equal(raw.frame, frame)
        assert raw.frame.flags.writeable
        assert (raw.exposure, raw.metadata) == (8.0, {"camera": "IMX226"})


@pytest.mark.parametrize(("order", "code"), [("big", ">u2"), ("little", "<u2")])
def test_binary_byte_order(tmp_path, frame, order, code):
    (tmp_path / "f.raw").write_bytes(frame.astype(code).tobytes())
    facts = {"rows": 30, "columns": 41, "byte_order": order, "exposure": 1}
    (tmp_path / "f.json").write_text(json.dumps(facts))
    np.testing.assert_array_equal(read_raw(tmp_path / "f.raw").frame, frame)


def test_eight_bits_are_widened_not_scaled(tmp_path):
    from PIL import Image

    small = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.fromarray(small).save(tmp_path / "f.png")
    np.testing.assert_array_equal(read_raw(tmp_path / "f.png").frame, small)


def test_stack_and_folder_one_by_one(tmp_path):
    """Frames come in their natural order, and only one is in memory at a time."""
    import tifffile

    stack = np.zeros((12, 400, 500), np.uint16) + np.arange(12, dtype=np.uint16)[:, None, None]
    tifffile.imwrite(tmp_path / "stack.tiff", stack, photometric="minisblack")
    with pytest.raises(InputError, match="several frames"):
        read_raw(tmp_path / "stack.tiff")
    del stack
    next(read_raws(tmp_path / "stack.tiff"))
    tracemalloc.start()
    assert [int(raw.frame[0, 0]) for raw in read_raws(tmp_path / "stack.tiff")] == list(range(12))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 400 * 500 * 2

    folder = tmp_path / "sweep"
    folder.mkdir()
    for number in (10, 2, 1):
        write_raw(folder / f"frame{number}.npy", Raw(np.full((2, 2), number, np.uint16), 1.0))
    (folder / ".half-written.tiff").write_bytes(b"II")
    assert [int(raw.frame[0, 0]) for raw in read_raws(folder)] == [1, 2, 10]
    with pytest.raises(InputError, match="folder"):
        read_raw(folder)


def test_wrong_frames_are_refused(tmp_path, frame):
    import tifffile
    from PIL import Image

    tifffile.imwrite(tmp_path / "float.tiff", frame.astype(np.float32))
    Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(tmp_path / "rgb.png")
    Image.fromarray(np.zeros((4, 5), np.uint8)).convert("P").save(tmp_path / "palette.tiff")
    np.save(tmp_path / "nan.npy", np.full((4, 5), np.nan))
    np.save(tmp_path / "long.npy", frame.astype(np.int64))
    np.save(tmp_path / "empty.npy", np.zeros((0, 5), np.uint16))
    np.save(tmp_path / "object.npy", np.array([{}], object), allow_pickle=True)
    (tmp_path / "text.tiff").write_text("no picture")
    (tmp_path / "other.jpg").write_bytes(b"\xff\xd8")
    (tmp_path / "lonely.raw").write_bytes(frame.tobytes())
    (tmp_path / "short.raw").write_bytes(frame.tobytes()[:-2])
    (tmp_path / "short.json").write_text('{"rows": 30, "columns": 41}')
    (tmp_path / "odd.raw").write_bytes(frame.tobytes())
    (tmp_path / "odd.json").write_text('{"rows": 30, "columns": 41, "dtype": "float32"}')
    names = "float.tiff rgb.png nan.npy long.npy empty.npy object.npy text.tiff other.jpg"
    for name in [*names.split(), "lonely.raw", "short.raw", "odd.raw", "gone.tiff"]:
        with pytest.raises(InputError) as caught:
            read_raw(tmp_path / name)
        assert "\n" not in str(caught.value)
    for text in ('{"exposure": "8 ms"}', '{"exposure": NaN}', '{"exposure": -1}', "[8]", "{"):
        np.save(tmp_path / "f.npy", frame)
        (tmp_path / "f.json").write_text(text)
        with pytest.raises(InputError):
            read_raw(tmp_path / "f.npy")
    with pytest.raises(InputError):
        Raw(frame.astype(float))
    with pytest.raises(InputError, match="plain"):
        write_raw(tmp_path / "f.tiff", Raw(frame, 1.0, {"path": tmp_path}))
    with pytest.raises(InputError):
        write_raw(tmp_path / "f.jpg", Raw(frame))


def test_header_that_promises_too_much(tmp_path):
    """Small files that claim to be enormous are refused before memory is taken."""
    import tifffile

    tifffile.imwrite(tmp_path / "f.tiff", np.zeros((100, 100), np.uint16))
    with tifffile.TiffFile(tmp_path / "f.tiff", mode="r+b") as tiff:
        tiff.pages.first.tags["ImageWidth"].overwrite(60000)
        tiff.pages.first.tags["ImageLength"].overwrite(60000)
    (tmp_path / "f.raw").write_bytes(b"\0" * 100)
    (tmp_path / "f.json").write_text('{"rows": 60000, "columns": 60000}')
    header = "{'descr': '<u2', 'fortran_order': False, 'shape': (60000, 60000), }"
    packed = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    (tmp_path / "f.npy").write_bytes(packed + b"\0" * 100)
    tracemalloc.start()
    for name in ("f.tiff", "f.raw", "f.npy"):
        with pytest.raises(InputError):
            read_raw(tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
