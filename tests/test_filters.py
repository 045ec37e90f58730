"""Filter arrays: the recipes, the incoherent plate, tables from files, the command line."""

import json
from dataclasses import replace
from importlib.resources import files as package_files

import numpy as np
import pytest
import torch
from tmm import coh_tmm
from typer.testing import CliRunner

from squilla.camera.design import CameraDesign
from squilla.camera.twin import Camera
from squilla.cli.filters import app
from squilla.errors import InputError
from squilla.optics.filters import (
    FabryPerotRecipe,
    FilterArray,
    FreeRecipe,
    MeasuredFilters,
    StencilRecipe,
    linear_variable_filter,
    read_filters,
)
from squilla.optics.materials import refractive_index
from squilla.optics.tables import band_pass
from squilla.spectra import grid

IMEC = package_files("squilla") / "data" / "responses" / "spectral_responses_5x5.mat"


def bell(centre, width=15.0):
    wavelength = grid(400, 800)
    return MeasuredFilters(
        wavelength, np.exp(-(((wavelength[None] - np.atleast_1d(centre)[:, None]) / width) ** 2))
    )


# --- the stencil process ----------------------------------------------------------------------


def test_recipe_is_followed():
    recipe = StencilRecipe()
    for seed in range(20):
        array = recipe.draw(seed)
        high = np.array([name.startswith("TiO2") for name in array.material])
        assert high[0]
        assert high[-1]
        assert np.all(high[1:] != high[:-1])
        thickness = array.thickness.numpy()
        assert np.all((thickness[high] >= 25) & (thickness[high] <= 145))
        assert np.all((thickness[~high] >= 45) & (thickness[~high] <= 255))
        absent = (~array.layers).sum(-1)
        assert absent.min() >= 2
        assert absent.max() <= 5
        assert len(torch.unique(array.layers, dim=0)) == 36


def test_every_number_of_omitted_layers_is_drawn():
    absent = (~StencilRecipe(filters=200).draw(3).layers).sum(-1)
    assert set(absent.tolist()) == {2, 3, 4, 5}


def test_same_seed_same_array():
    once, again, other = (StencilRecipe().draw(seed) for seed in (4, 4, 5))
    assert torch.equal(once.thickness, again.thickness)
    assert torch.equal(once.layers, again.layers)
    assert not torch.equal(once.thickness, other.thickness)
    generator = torch.Generator().manual_seed(4)
    assert torch.equal(StencilRecipe().draw(generator).layers, once.layers)


def test_impossible_recipes_are_refused():
    with pytest.raises(InputError, match="3 ways"):
        StencilRecipe(filters=4, depositions=3, omitted=(1, 1))
    with pytest.raises(InputError, match="cannot lack"):
        StencilRecipe(depositions=3, omitted=(2, 5))


def test_plate_with_film_agrees_with_tmm():
    """Film by tmm, the glass' back face by summing the light that runs to and fro in the plate."""
    array = replace(StencilRecipe(low="SiO2/Malitson").draw(1), scatter=0.9)
    wavelength, angle = np.array([520.0, 640.0]), 0.25
    result = array.transmittance(wavelength, angle)
    for m in (0, 17):
        for k, lam in enumerate(wavelength):
            stack = [
                (refractive_index(name, lam)[0].real, float(d))
                for name, d, there in zip(
                    array.material, array.thickness, array.layers[m], strict=True
                )
                if there
            ][::-1]  # light meets the last deposition first
            glass = refractive_index(array.substrate, lam)[0].real
            inside = np.arcsin(np.sin(angle) / glass)
            total = 0
            for polarization in "sp":
                film = coh_tmm(
                    polarization, [1, *(n for n, _ in stack), glass],
                    [np.inf, *(d for _, d in stack), np.inf], angle, lam,
                )  # fmt: skip
                back = coh_tmm(polarization, [glass, 1], [np.inf, np.inf], inside, lam)
                rounds = ((1 - film["T"]) * back["R"]) ** np.arange(60)
                total += film["T"] * back["T"] * rounds.sum() / 2
            assert result[m, k].item() == pytest.approx(0.9 * total, abs=1e-5)


def test_angles_become_the_first_axis():
    array = StencilRecipe(filters=5).draw(0)
    wavelength = grid(500, 750, 10)
    both = array.transmittance(wavelength, [0.0, 0.2])
    assert both.shape == (2, 5, 26)
    assert both.dtype == torch.float64
    for angle, part in zip((0.0, 0.2), both, strict=True):
        torch.testing.assert_close(part, array.transmittance(wavelength, angle))


def test_stack_shifts_to_the_blue_by_the_effective_index():
    """A tilted array looks as the shift model with one effective_index near 1.75 says."""
    array = StencilRecipe().draw(2)
    wavelength = grid(480, 800)
    flat = MeasuredFilters(
        wavelength, array.transmittance(wavelength).numpy(), effective_index=1.75
    )
    true = array.transmittance(grid(), 0.15)
    unshifted = (array.transmittance(grid()) - true).abs().mean()
    assert (flat.transmittance(grid(), 0.15) - true).abs().mean() < 0.25 * unshifted


@pytest.mark.parametrize("recipe", [StencilRecipe(), FreeRecipe(), FabryPerotRecipe()])
def test_array_survives_its_file(tmp_path, recipe):
    array = recipe.draw(6)
    array.save(tmp_path / "array.toml")
    again = read_filters(tmp_path / "array.toml")
    assert isinstance(again, FilterArray)
    assert torch.equal(again.transmittance(grid()), array.transmittance(grid()))


# --- other recipes ----------------------------------------------------------------------------


def test_free_filters_have_stacks_of_their_own_within_the_limits():
    recipe = FreeRecipe(filters=50)
    array = recipe.draw(1)
    least, most = recipe.limits
    assert array.thickness.shape == (50, 19)
    assert ((array.thickness >= least) & (array.thickness <= most)).all()
    assert array.layers.all()
    alone = [
        FilterArray(array.material, row, array.layers[:1], array.substrate, array.scatter)
        for row in array.thickness[:3]
    ]
    together = array.transmittance(grid())[:3]
    for one, response in zip(alone, together, strict=True):
        torch.testing.assert_close(one.transmittance(grid())[0], response)


def test_spacers_of_cavities_step_evenly():
    recipe = FabryPerotRecipe(filters=11, mirror=5)
    for seed in range(5):
        array = recipe.draw(seed)
        spacer = array.stacks[:, 5:-5].sum(-1)
        steps = spacer.diff()
        torch.testing.assert_close(steps, steps[:1].expand_as(steps))
        n = refractive_index(recipe.low, 600.0).real[0]
        order = 2 * n * spacer[0] / 500
        assert order.item() == pytest.approx(round(order.item()), abs=0.01)
        assert array.layers[:, :5].all()
        assert array.layers[:, -5:].all()


def test_a_cavity_transmits_where_its_closed_form_says():
    """Between two mirrors of amplitude reflectance r, the phase of the round trip sets the peak."""
    recipe = FabryPerotRecipe(filters=8, order=(1, 1), centre=(610, 610), mirror=5, scatter=1.0)
    array = recipe.draw(0)
    wavelength = grid(560, 670, 0.25)
    response = array.transmittance(wavelength).numpy()
    first, last = slice(0, 5), slice(4, None, -1)  # the first mirror, seen from the glass and back
    found = 0
    for row, spacer in zip(response, array.stacks[:, 5:-5].sum(-1).tolist(), strict=True):
        phase = []
        for lam in wavelength:
            index = [refractive_index(m, lam)[0].real for m in array.material[:5]]
            within = refractive_index(recipe.low, lam)[0].real
            glass = refractive_index(array.substrate, lam)[0].real
            mirrors = [
                coh_tmm(
                    "s", [within, *index[part], behind],
                    [np.inf, *array.thickness[:5].tolist()[part], np.inf], 0, lam,
                )["r"]
                for part, behind in ((first, 1.0), (last, glass))
            ]  # fmt: skip
            round_trip = np.exp(4j * np.pi * within * spacer / lam)
            phase.append(np.angle(mirrors[0] * mirrors[1] * round_trip))
        crossing = (np.diff(np.sign(phase)) < 0) & (np.abs(phase[1:]) < 1)
        for peak in wavelength[1:][crossing]:
            near = np.abs(wavelength - peak) < 8
            assert wavelength[near][row[near].argmax()] == pytest.approx(peak, abs=1.0)
            found += 1
    assert found >= 4


def test_a_wedge_transmits_where_it_was_cut():
    peaks = np.linspace(560, 680, 11)
    for response, peak in zip(
        linear_variable_filter(11, (560, 680), mirror=7).transmittance(grid()), peaks, strict=True
    ):
        near = np.abs(grid() - peak) < 30  # further off, the mirrors reflect no more
        assert grid()[near][response[near].argmax()] == pytest.approx(peak, abs=4)
        assert response[near].max() > 30 * response[near][[0, -1]].max()


def test_ideal_band_pass_filters():
    table = band_pass(25, grid(), fwhm=20.0, peak=0.8)
    assert table.values.max() == pytest.approx(0.8, rel=1e-3)
    peak = grid()[table.values.argmax(-1)]
    np.testing.assert_allclose(peak, np.arange(505, 750, 10), atol=0.5)
    assert np.sum(table.values[12] > 0.4) in (19, 20, 21)


def test_impossible_cavities_are_refused():
    with pytest.raises(InputError, match="odd number"):
        FabryPerotRecipe(mirror=4)


def test_shapes_that_do_not_fit_are_refused():
    array = StencilRecipe(filters=5).draw(0)
    for thickness in (array.thickness[:-1], torch.ones(4, 19), torch.ones(2, 5, 19)):
        with pytest.raises(InputError, match="19 thicknesses"):
            replace(array, thickness=thickness)


# --- measured tables --------------------------------------------------------------------------


def test_imec_responses():
    table = read_filters(str(IMEC), wavelength=grid(400, 1000))
    assert isinstance(table, MeasuredFilters)
    response = table.transmittance(grid(600, 800))
    assert response.shape == (25, 201)
    from scipy.io import loadmat

    file = loadmat(str(IMEC))
    peak = grid(400, 1000)[table.values.argmax(-1)]
    # The maker's central wavelengths are of the main peaks, of which a few lie elsewhere.
    assert np.median(np.abs(peak - file["CentralWavelengths"].ravel())) < 10


def test_mat_without_wavelength_asks_for_it():
    with pytest.raises(InputError, match="names no wavelengths"):
        read_filters(str(IMEC))
    with pytest.raises(InputError, match="601"):
        read_filters(str(IMEC), wavelength=grid(400, 999))


def test_every_kind_of_table_reads_alike(tmp_path):
    import xarray
    from scipy.io import savemat

    truth = bell([520, 600, 680])
    wavelength, values = truth.wavelength, truth.values
    columns = np.column_stack([wavelength, values.T])
    np.savetxt(tmp_path / "t.csv", columns, "%.17g", ",", header="wavelength,a,b,c", comments="")
    np.save(tmp_path / "t.npy", values)
    np.savez(tmp_path / "t.npz", wavelength=wavelength, filters=values)
    savemat(tmp_path / "t.mat", {"Wavelength": wavelength[::-1], "T": values.T[::-1]})
    xarray.DataArray(
        values.T, dims=("wavelength", "filter"), coords={"wavelength": wavelength}, name="t"
    ).to_netcdf(tmp_path / "t.nc", engine="h5netcdf")
    for suffix in ("csv", "npy", "npz", "mat", "nc"):
        own = {"wavelength": wavelength} if suffix == "npy" else {}
        table = read_filters(tmp_path / f"t.{suffix}", **own)
        np.testing.assert_array_equal(table.wavelength, wavelength)
        np.testing.assert_array_equal(table.values, values)


def test_shift_moves_a_peak_where_the_model_says():
    table = replace(bell(600.0), effective_index=1.8)
    wavelength = grid(500, 700, 0.1)
    angle = np.array([0.0, 0.1, 0.3])
    peak = wavelength[table.transmittance(wavelength, angle)[:, 0].argmax(-1)]
    np.testing.assert_allclose(peak, 600 * np.sqrt(1 - (np.sin(angle) / 1.8) ** 2), atol=0.51)
    unshifted = bell(600.0).transmittance(wavelength, angle)
    assert torch.equal(unshifted[0], unshifted[2])


def test_nothing_is_extrapolated_but_the_shift_at_the_edge():
    table = replace(bell(790.0), effective_index=1.8)
    assert torch.isfinite(table.transmittance(grid(500, 800), 0.3)).all()
    with pytest.raises(InputError, match="400-800 nm"):
        table.transmittance(grid(500, 801))
    with pytest.raises(InputError, match="400-800 nm"):
        table.transmittance(grid(399, 800), 0.3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("t.xlsx", "", "expected .toml"),
        ("t.csv", "500,0.1\n501,nan\n", "NaN"),
        ("t.mat", "no matlab", "cannot be read"),
        ("t.npy", "", "is empty"),
        ("t.npz", "no archive", "cannot be read"),
        ("t.nc", "no NetCDF", "cannot be read"),
        ("t.toml", "layers = ['01']", "'material' is missing"),
        ("t.toml", "layers = ['02']", "no filter array"),
    ],
)
def test_bad_files(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_filters(tmp_path / name)


def test_a_place_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        StencilRecipe().draw().save(tmp_path / "none" / "array.toml")


def test_wedges_and_bands_that_cannot_be():
    with pytest.raises(InputError, match="odd"):
        linear_variable_filter(mirror=4)
    with pytest.raises(InputError, match="width"):
        band_pass(fwhm=0.0)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no file"):
        read_filters(tmp_path / "none.csv")


# --- the command line -------------------------------------------------------------------------


def test_analyse_thesis():
    result = CliRunner().invoke(app, ["analyse", "thesis", "--seed", "3", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.output)
    response = StencilRecipe().draw(3).transmittance(grid())
    assert figures["throughput"] == pytest.approx(response.mean().item())
    assert len(figures["singular_values"]) == 36
    text = CliRunner().invoke(app, ["analyse", "thesis", "--seed", "3"])
    assert f"{figures['throughput']:.3f}" in text.output
    error = figures["expected_error"]
    assert error["20 dB"] > error["30 dB"] > error["40 dB"] > 0


def test_analyse_takes_the_seed_of_the_camera():
    result = CliRunner().invoke(app, ["analyse", "thesis", "--json"])
    camera = CameraDesign.load("thesis")
    response = StencilRecipe().draw(camera.filters.seed).transmittance(grid())
    assert json.loads(result.output)["throughput"] == pytest.approx(response.mean().item())


@pytest.mark.parametrize("name", ["band-pass", "mosaic-16", "sequential-16"])
def test_analyse_shows_the_filters_that_the_camera_has(name):
    """Not those of the thesis' recipe, and one for each channel, not for each lens."""
    result = CliRunner().invoke(app, ["analyse", name, "--json"])
    figures = json.loads(result.output)
    response = Camera(name).filters.transmittance(grid())
    assert figures["filters"] == len(response)
    assert figures["throughput"] == pytest.approx(response.mean().item())


def test_analyse_table():
    result = CliRunner().invoke(app, ["analyse", str(IMEC), "--wavelength", "400:1000:1", "--json"])
    assert json.loads(result.output)["wavelength"] == [400, 1000, 601]


def test_analyse_refuses_nonsense():
    for arguments in (
        ["thesisx"],
        ["thesis", "--wavelength", "all"],
        ["thesis", "--wavelength", "400:inf:1"],
        ["thesis", "--wavelength", "400:1000:1"],
        [str(IMEC), "--wavelength", "400:1000:1", "--seed", "3"],
    ):
        result = CliRunner().invoke(app, ["analyse", *arguments])
        assert isinstance(result.exception, InputError), arguments


def test_cavities_too_alike_to_be_made_are_refused():
    with pytest.raises(InputError, match="less than can be deposited"):
        FabryPerotRecipe(36, band=(600.0, 650.0), order=(1, 1)).draw(0)


def test_free_filters_need_a_layer():
    with pytest.raises(InputError, match="one filter or more"):
        FreeRecipe(filters=0)
