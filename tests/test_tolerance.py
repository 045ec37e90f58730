import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from squilla.cli.filters import app
from squilla.errors import InputError
from squilla.optics.filters import FreeRecipe, StencilRecipe
from squilla.optics.merit import Prior, WhiteNoise
from squilla.optics.plots import plot_tolerance
from squilla.optics.tolerance import ProcessErrors, coated, tolerance
from squilla.spectra import grid

BAND = grid(500, 750, 5)
NATURAL = Prior.draw("natural", BAND, count=3000)
ARRAY = StencilRecipe(filters=12).draw(13)
FAULTS = [
    ProcessErrors(scale=0.01),
    ProcessErrors(deposition=0.02),
    ProcessErrors(layer=0.01),
    ProcessErrors(misalignment=0.03),
    ProcessErrors(index={"TiO2/Franta": "TiO2/Siefke"}),
]


def judge(errors, count=40, snr=25, array=ARRAY):
    generator = torch.Generator().manual_seed(0)
    return tolerance(
        array, errors, NATURAL, noise=WhiteNoise(snr), count=count, generator=generator
    )


def test_no_faults_change_nothing():
    found = judge(ProcessErrors(), count=3)
    assert found.change.max() < 1e-14
    for error in (found.fixed, found.recalibrated):
        torch.testing.assert_close(error, torch.full((3,), found.nominal, dtype=torch.float64))


@pytest.mark.parametrize("errors", FAULTS, ids=str)
def test_calibrating_anew_never_hurts(errors):
    found = judge(errors)
    assert (found.change > 0).all()
    assert (found.fixed > found.recalibrated).all()
    for values in (found.change, found.fixed, found.recalibrated):
        assert values.shape == (40,)
        assert values.isfinite().all()


@pytest.mark.parametrize("name", ["scale", "deposition", "layer", "misalignment"])
def test_change_grows_in_proportion_to_small_faults(name):
    small, large = (judge(replace(ProcessErrors(), **{name: size})) for size in (1e-4, 3e-4))
    torch.testing.assert_close(large.change, 3 * small.change, rtol=0.05, atol=0)


def test_a_common_scale_stretches_the_wavelengths(tmp_path):
    """Without dispersion a stack 1 % thicker shows at a wavelength 1 % longer what it showed."""
    names = []
    for index in (2.3, 1.46, 1.52):
        path = tmp_path / f"{index}.csv"
        path.write_text(f"wavelength,n\n300,{index}\n1000,{index}\n")
        names.append(str(path))
    recipe = StencilRecipe(filters=6, high=names[0], low=names[1], substrate=names[2])
    array = recipe.draw(0)
    generator = torch.Generator().manual_seed(1)
    made = coated(array, ProcessErrors(scale=0.02), BAND, count=5, generator=generator)
    factors = 1 + 0.02 * torch.randn(5, dtype=torch.float64, generator=generator.manual_seed(1))
    for response, factor in zip(made, factors.tolist(), strict=True):
        torch.testing.assert_close(response, array.transmittance(BAND / factor))


def test_depositions_are_shared_and_layers_are_not():
    twins = replace(ARRAY, layers=ARRAY.layers[:1].expand(4, -1))
    generator = torch.Generator().manual_seed(0)
    shared = coated(twins, ProcessErrors(deposition=0.02), BAND, count=3, generator=generator)
    torch.testing.assert_close(shared, shared[:, :1].expand_as(shared))
    assert (shared[0] - shared[1]).abs().max() > 1e-3
    own = coated(twins, ProcessErrors(layer=0.02), BAND, count=3, generator=generator)
    assert ((own - own[:, :1]).abs().amax(-1)[:, 1:] > 1e-3).all()


def test_filters_with_stacks_of_their_own_share_nothing():
    array = FreeRecipe(filters=3, depositions=5).draw(0)
    made = coated(array, ProcessErrors(deposition=0.02, misalignment=0.02), BAND, count=4)
    assert made.shape == (4, 3, len(BAND))


def test_a_misaligned_filter_is_the_mean_of_its_parts():
    """Lacking one layer, it transmits between the stacks without and with it, by area."""
    layers = torch.ones(1, 19, dtype=torch.bool)
    layers[0, 8] = False
    array = replace(ARRAY, layers=layers)
    without = array.transmittance(BAND)
    full = replace(array, layers=torch.ones_like(layers)).transmittance(BAND)
    made = coated(array, ProcessErrors(misalignment=0.05), BAND, count=200)
    share = ((made - without) * (full - without)).sum((-2, -1)) / (full - without).square().sum()
    torch.testing.assert_close(made, without + share[:, None, None] * (full - without))
    assert share.min() >= 0
    assert share.square().mean().sqrt() == pytest.approx(0.05, rel=0.25)


def test_another_material_is_another_material():
    swapped = ProcessErrors(index={"TiO2/Franta": "TiO2/Siefke"})
    other = tuple("TiO2/Siefke" if name == "TiO2/Franta" else name for name in ARRAY.material)
    expected = replace(ARRAY, material=other).transmittance(BAND)
    made = coated(ARRAY, swapped, BAND, count=2)
    torch.testing.assert_close(made, expected.expand(2, -1, -1))


def test_faults_that_cannot_be():
    with pytest.raises(InputError, match=r"layer error is 1\.0"):
        ProcessErrors(layer=1.0)
    with pytest.raises(InputError, match="no layer of SiO2/Malitson"):
        coated(ARRAY, ProcessErrors(index={"SiO2/Malitson": "SiO2/Gao"}), BAND, count=1)


def test_figure_has_a_panel_for_each_fault():
    sizes = [0.001, 0.01]
    found = [judge(ProcessErrors(layer=size), count=5) for size in sizes]
    figure = plot_tolerance({"layer": (sizes, found), "again": (sizes, found)}, "faults")
    assert [axes.get_title() for axes in figure.axes] == ["layer", "again"]


# --- the command line -------------------------------------------------------------------------


def test_tolerance_from_the_command_line(tmp_path):
    ARRAY.save(tmp_path / "array.toml")
    arguments = ["tolerance", str(tmp_path / "array.toml"), "--count", "20"]
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert set(figures) == {"scale 1 %", "deposition 1 %", "layer 1 %", "misalignment 1 %"}
    for row in figures.values():
        assert row["fixed"][0] >= row["recalibrated"][0]
        assert row["fixed"][1] >= row["fixed"][0]
    faults = ["--layer", "1", "--index", "TiO2/Franta=TiO2/Siefke", "--snr", "30"]
    text = CliRunner().invoke(app, [*arguments, *faults])
    assert "all together" in text.output
    assert "coated 20 times" in text.output


def test_a_table_cannot_be_coated(tmp_path):
    np.savetxt(tmp_path / "t.csv", np.column_stack([grid(), grid() / 1000]), delimiter=",")
    result = CliRunner().invoke(app, ["tolerance", str(tmp_path / "t.csv")])
    assert "table of responses" in str(result.exception)
    ARRAY.save(tmp_path / "array.toml")
    result = CliRunner().invoke(app, ["tolerance", str(tmp_path / "array.toml"), "--index", "TiO2"])
    assert "NAME=NAME" in str(result.exception)
