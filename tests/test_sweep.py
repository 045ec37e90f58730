"""Sweeps: every combination once, however often the run is broken off; the two that ship."""

import csv
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from squilla.batch.sweep import sweep
from squilla.cli.app import app
from squilla.errors import InputError
from squilla.optics.filters import read_filters


def product(a: float, b: float, log: str) -> dict:
    """Note each call, refuse one case, and break off where a file says so."""
    with Path(log).open("a") as stream:
        stream.write(f"{a} {b}\n")
    if (a, b) == (2, 20) and Path(log).with_name("break").exists():
        raise KeyboardInterrupt
    if (a, b) == (1, 20):
        raise InputError("1 and 20 do not go together.")
    return {"product": a * b}


OVER = {"a": [1, 2], "b": [10, 20, 30]}


def test_each_combination_is_done_once(tmp_path):
    log = tmp_path / "calls"
    (tmp_path / "break").touch()
    fixed = {"log": str(log)}
    with pytest.raises(KeyboardInterrupt):
        sweep(product, OVER, tmp_path / "out", fixed=fixed, workers=1)
    (tmp_path / "break").unlink()
    seen = []
    rows = sweep(
        product, OVER, tmp_path / "out", fixed=fixed, workers=1,
        progress=lambda ended, of: seen.append((ended, of)),
    )  # fmt: skip
    calls = log.read_text().splitlines()
    # The one that was broken off and the one that failed are tried again, the others are not.
    assert calls == ["1 10", "1 20", "1 30", "2 10", "2 20", "1 20", "2 20", "2 30"]
    assert (seen[0], seen[-1]) == ((3, 6), (6, 6))
    assert [row.get("product") for row in rows] == [10, None, 30, 20, 40, 60]
    with (tmp_path / "out" / "table.csv").open() as stream:
        table = list(csv.DictReader(stream))
    assert [row["product"] for row in table] == ["10", "", "30", "20", "40", "60"]
    assert table[1]["failed"] == "1 and 20 do not go together."


def test_longer_lists_add_to_a_sweep_and_other_settings_are_refused(tmp_path):
    log = tmp_path / "calls"
    sweep(product, {"a": [2], "b": [10]}, tmp_path, fixed={"log": str(log)}, workers=1)
    rows = sweep(product, {"a": [2], "b": [10, 30]}, tmp_path, fixed={"log": str(log)}, workers=1)
    assert [row["product"] for row in rows] == [20, 60]
    assert len(log.read_text().splitlines()) == 2
    with pytest.raises(InputError, match="begun with another fixed"):
        sweep(product, OVER, tmp_path, fixed={"log": str(tmp_path / "other")}, workers=1)
    with pytest.raises(InputError, match="nothing to sweep"):
        sweep(product, {"a": []}, tmp_path / "none")


def run(*arguments: object) -> list[dict]:
    result = CliRunner().invoke(app, ["sweep", *map(str, arguments), "--json"])
    if isinstance(result.exception, InputError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return json.loads(result.output)


def test_less_noise_less_error(camera, calibration, tmp_path):
    calibration.save(tmp_path / "camera.nc")
    (tmp_path / "small.toml").write_text(toml_of(camera.design))
    asked = ["noise", "chart", "--calibration", tmp_path / "camera.nc", "--camera"]
    asked += [tmp_path / "small.toml", "--snr", "15,35", "--seeds", 2, "-o", tmp_path / "out"]
    rows = run(*asked, "--workers", 1)
    assert [(row["snr"], row["seed"]) for row in rows] == [(15, 0), (15, 1), (35, 0), (35, 1)]
    away = [row["sam_deg"] for row in rows]
    assert max(away[2:]) < 0.8 * min(away[:2])
    assert len(set(away)) == 4  # each has noise of its own
    assert run(*asked) == rows  # nothing is left to do


def toml_of(design) -> str:
    """Return a camera design as TOML."""

    def value(given) -> str:
        return json.dumps(str(given) if isinstance(given, Path) else given)

    tree = design.model_dump(exclude_none=True)
    lines = [f"{key} = {value(each)}" for key, each in tree.items() if not isinstance(each, dict)]
    for name, section in tree.items():
        if not isinstance(section, dict):
            continue
        flat = {key: each for key, each in section.items() if not isinstance(each, dict)}
        lines += [f"[{name}]", *(f"{key} = {value(each)}" for key, each in flat.items())]
        for key, inner in section.items():
            if isinstance(inner, dict):
                lines += [f"[{name}.{key}]", *(f"{k} = {value(v)}" for k, v in inner.items())]
    return "\n".join(lines)


def test_filters_for_each_noise_are_written(tmp_path):
    asked = ["filters", "--recipe", "stencil,fabry-perot", "--snr", 20, "--seeds", 1]
    asked += ["--draws", 2, "--starts", 1, "--rounds", 0, "-o", tmp_path, "--workers", 1]
    rows = run(*asked)
    assert [row["file"] for row in rows] == ["stencil-20dB-0.toml", "fabry-perot-20dB-0.toml"]
    for row in rows:
        assert 0 < row["expected_error"] == row["best_drawn"] <= row["median_drawn"]
        assert read_filters(tmp_path / row["file"]).layers.shape[0] == 36
    with pytest.raises(InputError, match="no list of numbers"):
        run("filters", "--snr", "twenty", "-o", tmp_path / "b")


def test_a_recipe_that_is_none_fails_alone(tmp_path):
    asked = ["sweep", "filters", "--recipe", "magic", "--snr", "20", "--seeds", "1"]
    result = CliRunner().invoke(app, [*asked, "-o", str(tmp_path), "--workers", "1"])
    assert result.exit_code == 1
    assert "There is no recipe 'magic'; there are stencil, free, fabry-perot." in result.output
