"""The examples run as they stand, and draw what the gallery shows."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DRAWN = {"metamers", "relief", "any_camera", "find_alike"}


def test_every_picture_of_the_gallery_has_its_example():
    shown = {path.stem.removeprefix("gallery_") for path in ROOT.glob("docs/images/gallery_*")}
    assert shown == DRAWN
    page = (ROOT / "docs/gallery.md").read_text()
    assert all(f"examples/{path.name}" in page for path in ROOT.glob("examples/*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted(DRAWN), "own_matrix"])
def test_example(name, tmp_path):
    """`first_cube.py` needs the demo, and stands as a tutorial of its own."""
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / f"{name}.py", tmp_path],
        capture_output=True, text=True, env=os.environ | {"MPLBACKEND": "Agg"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"{name}.webp").exists() == (name in DRAWN)
