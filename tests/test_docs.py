"""The pages fit together."""

from pathlib import Path

import pytest


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="pip install '.[docs]' to build the pages")
    pytest.importorskip("mkdocstrings", reason="pip install '.[docs]' to build the pages")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    root = Path(__file__).parents[1]
    build(load_config(str(root / "mkdocs.yml"), site_dir=str(tmp_path / "site"), strict=True))
    assert "Calibration" in (tmp_path / "site/reference/calibration/index.html").read_text()


def test_every_public_name_is_in_the_reference():
    import squilla

    pages = (Path(__file__).parents[1] / "docs" / "reference").glob("*.md")
    told = "\n".join(page.read_text() for page in pages).splitlines()
    for name, home in squilla._HOME.items():
        assert f"::: squilla.{home}" in told, name
