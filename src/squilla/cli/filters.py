"""squilla filters: look at filter arrays."""

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Look at filter arrays.", no_args_is_help=True)


@app.callback()
def _filters() -> None:
    """Look at filter arrays."""


@app.command()
def analyse(
    filters: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help='"thesis", or .toml .csv .npy .npz .mat .nc')
    ],
    seed: Annotated[int, typer.Option(help="Seed of the random thesis array.")] = 0,
    wavelength: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP:STEP", help="Wavelengths of a table that holds none itself, nm."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """Print how well the filters tell wavelengths apart, and how much light they pass.

    Examples: squilla filters analyse thesis --seed 3;
    squilla filters analyse measured.mat --wavelength 400:1000:1
    """
    from squilla.errors import InputError
    from squilla.optics import filters as optics
    from squilla.optics import merit
    from squilla.spectra import grid

    own = None
    if wavelength is not None:
        try:
            start, stop, step = map(float, wavelength.split(":"))
            own = grid(start, stop, step)
        except (ValueError, ZeroDivisionError):
            raise InputError(
                f"--wavelength is {wavelength!r}; expected START:STOP:STEP such as 400:1000:1."
            ) from None
    if filters == "thesis":
        array = optics.StencilRecipe().draw(seed)
    elif Path(filters).suffix:
        array = optics.read_filters(filters, wavelength=own)
    else:
        raise InputError(f'There are no filters named {filters!r}; give "thesis" or a file.')
    band = array.wavelength if isinstance(array, optics.MeasuredFilters) else grid()
    response = array.transmittance(band)
    values = merit.singular_values(response)
    every = max(1, round(10 * (len(band) - 1) / (band[-1] - band[0])))
    figures = {
        "filters": len(response),
        "wavelength": [float(band[0]), float(band[-1]), len(band)],
        "throughput": float(merit.throughput(response)),
        "mean_correlation": float(merit.mean_correlation(response)),
        "mutual_coherence": float(merit.mutual_coherence(response[:, ::every])),
        "peak_density": merit.peak_density(response, band),
        "condition_number": float(merit.condition_number(response)),
        "singular_values": values.tolist(),
    }
    if as_json:
        typer.echo(json.dumps(figures))
        return
    shown = [k for k in (2, 5, 10, 15, 20, 30) if k <= len(values)]
    typer.echo(
        f"{figures['filters']} filters, {band[0]:g}-{band[-1]:g} nm, {len(band)} bands\n"
        f"mean transmittance              {figures['throughput']:.3f}\n"
        f"mean |correlation| of filters   {figures['mean_correlation']:.3f}\n"
        f"largest cosine, bands 10 nm off {figures['mutual_coherence']:.3f}\n"
        f"peaks per 100 nm                {figures['peak_density']:.2f}\n"
        f"condition number                {figures['condition_number']:.3g}\n"
        f"singular values                 " + "  ".join(f"s{k} {values[k - 1]:.2g}" for k in shown)
    )
