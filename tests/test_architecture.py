"""The house: imports point one way, and the front door opens fast."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import squilla

SOURCE = Path(squilla.__file__).parent
ORDER = (
    "errors", "threads", "spectra", "priors", "colour", "files", "optics", "camera", "calibration",
    "reconstruction", "training", "evaluation", "live", "batch", "demo", "cli", "__main__",
)  # fmt: skip
MODULES = sorted(path for path in SOURCE.rglob("*.py") if path != SOURCE / "__init__.py")


def room(name: str) -> str:
    return name.split(".")[1] if "." in name else ""


def imported(path: Path) -> set[str]:
    """Return the squilla modules that a file imports, anywhere in it, type checking included."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith("squilla.")}
        elif isinstance(node, ast.ImportFrom) and node.module:
            if node.module == "squilla":
                found |= {f"squilla.{squilla._HOME.get(a.name, a.name)}" for a in node.names}
            elif node.module.startswith("squilla."):
                found.add(node.module)
    return {name for name in found if room(name) != "__version__"}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_point_up(path):
    here = path.relative_to(SOURCE).parts[0].removesuffix(".py")
    for name in imported(path):
        assert ORDER.index(room(name)) <= ORDER.index(here), f"{here} imports {name}"


@pytest.mark.parametrize(
    ("here", "there"), [("camera", "reconstruction"), ("reconstruction", "camera")]
)
def test_twin_and_reconstruction_never_meet(here, there):
    for path in (SOURCE / here).rglob("*.py"):
        assert not any(room(name) == there for name in imported(path)), path


def test_import_is_light():
    """Neither torch nor anything else heavy is loaded before it is needed."""
    code = (
        "import sys, squilla, squilla.spectra, squilla.cli.app; "
        "heavy = {'torch', 'matplotlib', 'colour', 'xarray', 'scipy', 'numba'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", squilla.__all__)
def test_public_names_exist(name):
    assert getattr(squilla, name) is not None
