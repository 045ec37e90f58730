import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from squilla.cli.filters import app
from squilla.errors import InputError
from squilla.optics.design import exchange, optimise, refine, together
from squilla.optics.filters import FabryPerotRecipe, FreeRecipe, StencilRecipe, read_filters
from squilla.optics.merit import PhotonNoise, Prior, WhiteNoise, expected_error
from squilla.optics.plots import plot_search
from squilla.spectra import grid

BAND = grid(500, 750, 5)
NATURAL = Prior.draw("natural", BAND, count=3000)
SMALL = StencilRecipe(filters=8, depositions=7, omitted=(1, 3))


def error(response):
    return expected_error(response, NATURAL, noise=WhiteNoise(20))


@pytest.fixture(scope="module")
def search():
    return optimise(SMALL, error, BAND, draws=80, starts=2, rounds=2, seed=1)


def test_search_gains_and_says_what(search):
    assert search.merit < search.drawn.min() < search.drawn.median()
    assert error(search.array.transmittance(BAND)).item() == pytest.approx(search.merit)
    assert error(search.first.transmittance(BAND)).item() == pytest.approx(search.drawn.min())
    merits = [step.merit for step in search.history]
    assert merits == sorted(merits, reverse=True)
    assert merits[-1] == search.merit
    assert [step.stage for step in search.history[:80]] == ["draw"] * 80
    assert {step.stage for step in search.history[80:]} == {"improve"}


def test_search_stays_within_the_process(search):
    least, most = SMALL.limits
    assert search.array.thickness.shape == (7,)  # shared depositions stay shared
    assert ((search.array.thickness >= least) & (search.array.thickness <= most)).all()
    omitted = (~search.array.layers).sum(-1)
    assert omitted.min() >= 1
    assert omitted.max() <= 3
    assert len(torch.unique(search.array.layers, dim=0)) == 8
    assert search.array.material == SMALL.material


def test_same_seed_same_array(search):
    again = optimise(SMALL, error, BAND, draws=80, starts=2, rounds=2, seed=1)
    assert torch.equal(again.array.thickness, search.array.thickness)
    assert torch.equal(again.array.layers, search.array.layers)
    other = optimise(SMALL, error, BAND, draws=80, starts=2, rounds=0, seed=2)
    assert other.merit == other.drawn.min() == other.history[-1].merit
    assert not torch.equal(other.drawn, search.drawn)


def test_progress_is_told():
    told = []
    optimise(
        SMALL, error, BAND, draws=5, starts=1, rounds=1, progress=lambda *step: told.append(step)
    )
    assert [step[:3] for step in told] == [
        *(("draw", i, 5) for i in range(1, 6)),
        ("improve", 1, 1),
    ]


def test_refined_thickness_is_where_brute_force_finds_it():
    """One filter of two layers: no pair of thicknesses nearby, nor any step, is better."""
    recipe = FreeRecipe(filters=1, depositions=2)
    array, value = refine(recipe, recipe.draw(3), error, BAND)
    steps = torch.linspace(-3, 3, 25, dtype=torch.float64)
    shift = torch.cartesian_prod(steps, steps)[:, None]
    least, most = recipe.limits
    around = (array.thickness + shift).clamp(least, most)
    layers = array.layers.expand(len(shift), 1, 2)
    tried = error(replace(array, thickness=around, layers=layers).transmittance(BAND))
    assert value == pytest.approx(error(array.transmittance(BAND)).item())
    assert tried.min().item() > value * (1 - 1e-5)


def test_exchanged_masks_are_those_that_brute_force_finds():
    """Two filters that each lack one of four layers: no other single mask is better."""
    recipe = StencilRecipe(filters=2, depositions=4, omitted=(1, 1))
    start = recipe.draw(0)
    generator = torch.Generator().manual_seed(0)
    array = exchange(recipe, start, error, BAND, generator)
    value = error(array.transmittance(BAND))
    assert value <= error(start.transmittance(BAND))
    assert torch.equal(array.thickness, start.thickness)
    for which, layer in itertools.product(range(2), range(4)):
        layers = array.layers.clone()
        layers[which] = True
        layers[which, layer] = False
        if not torch.equal(layers[0], layers[1]):
            assert error(replace(array, layers=layers).transmittance(BAND)) >= value - 1e-12


def test_where_every_mask_is_taken_there_is_nothing_to_exchange():
    recipe = StencilRecipe(filters=4, depositions=4, omitted=(1, 1))
    start = recipe.draw(0)
    array = exchange(recipe, start, error, BAND, torch.Generator())
    assert torch.equal(array.layers, start.layers)


@pytest.mark.parametrize("noise", [WhiteNoise(25), PhotonNoise(500.0)])
@pytest.mark.parametrize(
    "recipe", [FreeRecipe(filters=4, depositions=5), FabryPerotRecipe(filters=6, order=(1, 1))]
)
def test_other_recipes_gain_within_their_limits(recipe, noise):
    def merit(response):
        return expected_error(response, NATURAL, noise=noise)

    found = optimise(recipe, merit, BAND, draws=10, starts=1, rounds=2)
    least, most = recipe.limits
    assert found.merit < 0.99 * found.drawn.min()
    assert ((found.array.thickness >= least) & (found.array.thickness <= most)).all()
    assert torch.equal(found.array.layers, found.first.layers)


def test_many_arrays_as_one():
    arrays = [SMALL.draw(seed) for seed in range(3)]
    both = together(arrays).transmittance(BAND, [0.0, 0.1])
    assert both.shape == (3, 2, 8, len(BAND))
    for array, response in zip(arrays, both, strict=True):
        torch.testing.assert_close(response, array.transmittance(BAND, [0.0, 0.1]))


def test_nonsense_is_refused():
    for given in ({"draws": 0}, {"draws": 2, "starts": 3}, {"starts": 0}, {"rounds": -1}):
        with pytest.raises(InputError, match="no search"):
            optimise(SMALL, error, BAND, **given)


def test_figure_shows_the_search(search):
    figure = plot_search(search, BAND, "small")
    titles = [axes.get_title() for axes in figure.axes]
    assert {"best drawn", "optimised"} <= set(titles)


# --- the command line -------------------------------------------------------------------------


def test_design_from_the_command_line(tmp_path):
    path, picture = tmp_path / "array.toml", tmp_path / "gained.png"
    arguments = ["design", "-o", str(path), "--plot", str(picture), "--exposure", "1000", "--json"]
    few = ["--draws", "3", "--starts", "1", "--rounds", "1", "--recipe", "fabry-perot"]
    result = CliRunner().invoke(app, [*arguments, *few])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["expected_error"] <= figures["best_drawn"] <= figures["median_drawn"]
    assert picture.stat().st_size > 10_000
    array = read_filters(path)
    response = array.transmittance(grid(step=2))
    assert figures["throughput"] == pytest.approx(response.mean().item())
    assert np.isfinite(response).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--recipe", "glass", "-o", "a.toml"], "no recipe"),
        (["-o", "a.csv"], "toml"),
        (["-o", "nowhere/a.toml"], "no folder"),
        (["-o", "a.toml", "--plot", "a.xls"], ".png, .pdf, .svg"),
        (["-o", "a.toml", "--snr", "20", "--exposure", "100"], "not both"),
        (["-o", "a.toml", "--prior", "nature"], "no prior"),
        (["-o", "a.toml", "--camera", "nobodys"], "no camera design"),
    ],
)
def test_design_refuses_nonsense(arguments, message):
    result = CliRunner().invoke(app, ["design", *arguments])
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
