"""Damaged and foreign files: every reader gives a result or one plain sentence, and nothing else.

The readers and their seeds are those of the fuzzer, ``tests/fuzz``.
"""

import random
import re
import sys
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))
from targets import CORPUS, TARGETS, prepare, run, small_calibration

from squilla.calibration.store import load_calibration
from squilla.errors import InputError
from squilla.reconstruction.models import load_model, model_class

FEW = settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture
def folder(tmp_path):
    """Return a folder laid out for a reader."""

    def laid_out(reader):
        place = tmp_path / reader
        if not place.exists():
            place.mkdir()
            prepare(TARGETS[reader], place)
        return place

    return laid_out


@pytest.mark.parametrize("reader", TARGETS)
def test_seeds_are_read(reader, folder):
    """What the fuzzer starts from is good; of a model only the weights are left out."""
    for seed in TARGETS[reader].seeds():
        taken = run(TARGETS[reader], seed, folder(reader))
        assert taken or reader in ("model", "depth-tiff")


@FEW
@given(data=st.data())
@pytest.mark.parametrize("reader", TARGETS)
def test_damage_is_told_in_a_sentence(reader, folder, data):
    """Bytes overwritten, cut out, put in, and files cut short."""
    seed = data.draw(st.sampled_from(TARGETS[reader].seeds()))
    damaged = bytearray(seed)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, max(len(damaged) - 1, 0)))
        length = data.draw(st.sampled_from([0, 1, 2, 4, 8, 64]))
        damaged[place : place + length] = data.draw(st.binary(max_size=8))
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged))) :]
    run(TARGETS[reader], bytes(damaged), folder(reader))


@FEW
@given(data=st.binary(max_size=200))
@pytest.mark.parametrize("reader", TARGETS)
def test_anything_at_all_is_told_in_a_sentence(reader, folder, data):
    run(TARGETS[reader], data, folder(reader))


@pytest.mark.parametrize(
    "file", sorted(CORPUS.glob("*/*")), ids=lambda file: f"{file.parent.name}/{file.name}"
)
def test_what_the_fuzzer_found_stays_mended(file, folder):
    """Each within 64 MiB, which none of these small files may ask for."""
    reader = file.parent.name
    tracemalloc.start()
    try:
        run(TARGETS[reader], file.read_bytes(), folder(reader))
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_a_flipped_bit_in_a_calibration_is_noticed(tmp_path):
    """Wherever it is: the file is refused, or nothing that is read from it has changed."""
    small_calibration().save(tmp_path / "sound.nc")
    whole = (tmp_path / "sound.nc").read_bytes()
    sound = load_calibration(tmp_path / "sound.nc")
    noticed = 0
    chosen = random.Random(1)
    for _ in range(300):
        bit = chosen.randrange(8 * len(whole))
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        (tmp_path / "flipped.nc").write_bytes(flipped)
        try:
            found = load_calibration(tmp_path / "flipped.nc")
        except InputError:
            noticed += 1
            continue
        assert (found.sensitivity == sound.sensitivity).all()
        assert (found.pixels.flat == sound.pixels.flat).all()
        assert (found.lattice.centre == sound.lattice.centre).all()
        assert found.provenance == sound.provenance
        assert (found.lattice.focal, found.pixels.gain) == (sound.lattice.focal, sound.pixels.gain)
    assert noticed > 0


def test_a_flipped_bit_in_a_model_is_noticed(tmp_path):
    from targets import _bare

    calibration = _bare()
    model_class("mlp")(calibration).save(tmp_path / "sound.safetensors")
    whole = (tmp_path / "sound.safetensors").read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    chosen = random.Random(2)
    places = [chosen.randrange(header, len(whole)) for _ in range(12)]
    for place in places:
        flipped = bytearray(whole)
        flipped[place] ^= 1
        (tmp_path / "flipped.safetensors").write_bytes(flipped)
        with pytest.raises(InputError, match=r"checksum|camera|finite"):
            load_model(tmp_path / "flipped.safetensors", calibration)


def test_no_reader_runs_code():
    """Pickles are how files run code: nothing here loads one."""
    source = Path(__file__).parents[1] / "src"
    for file in source.rglob("*.py"):
        text = re.sub(r"torch\.load\([^)]*weights_only=True\)", "", file.read_text())
        for word in ("torch.load(", "pickle.load", "allow_pickle=True", "yaml.load(", " eval("):
            assert word not in text, f"{file} says {word}"
