"""The tutorials run, as they stand on their pages: each block in turn, in one folder.

A block ``toml title="NAME"`` is written to that file; a comment ``<!-- needs: PAGE -->`` takes over
the files of another page.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

PAGES = Path(__file__).parents[1] / "docs" / "tutorials"
LONG = {"first-cube.md": "runs the whole demo, full size"}


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return the fenced blocks of a page: what stands behind the fence, and the text."""
    tokens = MarkdownIt().parse(page.read_text())
    return [(token.info, token.content) for token in tokens if token.type == "fence"]


def write_files(page: Path, folder: Path) -> None:
    for info, text in blocks(page):
        if title := re.search(r'title="([\w.]+)"', info):
            (folder / title[1]).write_text(text)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(page.name, marks=pytest.mark.slow if page.name in LONG else ())
        for page in sorted(PAGES.glob("*.md"))
    ],
)
def test_tutorial(name, tmp_path, monkeypatch, capsys):
    page = PAGES / name
    monkeypatch.chdir(tmp_path)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    monkeypatch.setenv("PATH", path)
    for needed in re.findall(r"<!-- needs: (\S+) -->", page.read_text()):
        write_files(PAGES / needed, tmp_path)
    write_files(page, tmp_path)
    names = {"__name__": "tutorial"}
    ran = 0
    for info, text in blocks(page):
        language = info.split(" ")[0]
        if language == "python":
            exec(compile(text, f"{name}, block {ran}", "exec"), names)
        elif language == "bash":
            done = subprocess.run(["bash", "-euc", text], capture_output=True, text=True)
            assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
        ran += language in ("python", "bash")
    assert ran > 1
