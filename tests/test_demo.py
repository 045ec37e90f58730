"""The main job end to end, on the small camera."""

import json

import pytest
import rasterio

from squilla.camera.design import design_path
from squilla.demo import demo
from squilla.errors import InputError
from squilla.files.cube import load_cube
from test_cli import SMALL


def test_demo_writes_everything(tmp_path):
    text = design_path("thesis").read_text()
    for old, new in SMALL.items():
        text = text.replace(old, new)
    (tmp_path / "small.toml").write_text(text)
    out = tmp_path / "demo"
    metrics = demo(
        out,
        camera=tmp_path / "small.toml",
        scenes=["chart", "corn-kernel"],
        models=["ridge", "sparse"],
        snr=30,
    )
    assert metrics == json.loads((out / "metrics.json").read_text())
    assert set(metrics) == {"chart", "corn-kernel"}
    for judged in metrics.values():
        assert judged["alignment_rms_px"] < 0.2
        assert {"mse", "rmse", "sam_deg", "psnr_db", "seconds"} <= set(judged["ridge"])
    assert metrics["chart"]["ridge"]["colours_mse"] < 0.02
    for name in ("raw.tiff", "calibration.nc", "report.html"):
        assert (out / name).stat().st_size > 0
    cube = load_cube(out / "chart-ridge.nc")
    assert (cube.wavelength.values[0], cube.wavelength.attrs["units"]) == (500, "nm")
    with rasterio.open(out / "chart-ridge.img") as envi:
        assert envi.count == 51
        assert float(envi.tags(1)["wavelength"]) == 500


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"snr": float("nan")}, "finite SNR"),
        ({"distance": float("inf")}, "positive distance"),
        ({"scenes": ["chart", "moon"]}, "indian-pines"),
        ({"models": ["magic"]}, "no model"),
        ({"camera": "pinhole"}, "no camera design"),
    ],
)
def test_what_cannot_be_shown_is_said_before_anything_is_made(tmp_path, given, says):
    with pytest.raises(InputError, match=says):
        demo(tmp_path / "demo", **given)
    assert not (tmp_path / "demo").exists()


def test_demo_needs_a_place(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        demo(tmp_path / "file" / "demo")
