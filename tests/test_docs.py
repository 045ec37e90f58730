"""The pages fit together."""

import re
from pathlib import Path

import pytest

import squilla


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="pip install '.[docs]' to build the pages")
    pytest.importorskip("mkdocstrings", reason="pip install '.[docs]' to build the pages")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    root = Path(__file__).parents[1]
    build(load_config(str(root / "mkdocs.yml"), site_dir=str(tmp_path / "site"), strict=True))
    assert "Calibration" in (tmp_path / "site/reference/calibration/index.html").read_text()


def test_every_public_name_stands_in_the_reference():
    pages = Path(__file__).parents[1] / "docs" / "reference"
    told = set(re.findall(r"^::: (\S+)", "".join(p.read_text() for p in pages.glob("*.md")), re.M))
    assert {f"squilla.{module}" for module in squilla._HOME.values()} <= told


def test_links_between_pages_lead_somewhere():
    root = Path(__file__).parents[1]
    for page in [root / "README.md", *(root / "docs").rglob("*.md")]:
        for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
            assert "://" in link or (page.parent / link).exists(), f"{page.name}: {link}"
