"""squilla filters: look at filter arrays, design them, ask what a coating process must hold."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import numpy as np

    from squilla.optics.filters import FilterArray
    from squilla.optics.tables import MeasuredFilters

app = typer.Typer(
    help="Look at filter arrays, design them, see what faults cost.", no_args_is_help=True
)

SnrOption = Annotated[
    float | None,
    typer.Option(metavar="DB", help="Noise alike in every filter; default: 20 dB."),
]
ExposureOption = Annotated[
    float | None,
    typer.Option(
        metavar="ELECTRONS",
        help="Shot and read noise where a pixel without a filter collects so many electrons of the "
        "mean spectrum.",
    ),
]
PriorOption = Annotated[
    str, typer.Option(help="Spectra to be seen: natural, broad, gaussian or line.")
]
CameraOption = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE", help="Whose band, quantum efficiency, read noise and units count."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]


@app.command()
def analyse(
    filters: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE",
            help="A built-in camera, or an array: .toml .csv .txt .npy .npz .mat .nc",
        ),
    ],
    seed: Annotated[
        int | None,
        typer.Option(min=0, max=10**9, help="Seed of a camera's random array; default: its own."),
    ] = None,
    wavelength: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP:STEP", help="Wavelengths of a table that holds none itself, nm."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print how well filters tell wavelengths apart.

    Beside that: how much light they pass, and what error they leave in reconstructed spectra.

    Examples: squilla filters analyse thesis --seed 3;
    squilla filters analyse measured.mat --wavelength 400:1000:1
    """
    from squilla.errors import InputError
    from squilla.optics import merit
    from squilla.spectra import grid

    own = None
    if wavelength is not None:
        try:
            start, stop, step = map(float, wavelength.split(":"))
            own = grid(start, stop, step)
        except ValueError:
            raise InputError(
                f"--wavelength is {wavelength!r}; expected START:STOP:STEP such as 400:1000:1."
            ) from None
    array, band = _filters(filters, seed=seed, wavelength=own)
    response = array.transmittance(band)
    if min(response.shape) < 2:
        raise InputError(
            f"{filters} holds {len(response)} filters at {len(band)} wavelengths; two of each are "
            "the least that can be compared."
        )
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
    inside = grid(step=2)
    if band[0] <= inside[0] and band[-1] >= inside[-1]:  # where spectra are known
        prior, seen = merit.Prior.draw("natural", inside), array.transmittance(inside)
        figures["expected_error"] = {
            f"{snr} dB": float(merit.expected_error(seen, prior, noise=merit.WhiteNoise(snr)))
            for snr in (20, 30, 40)
        }
    if as_json:
        typer.echo(json.dumps(figures))
        return
    shown = [k for k in (2, 5, 10, 15, 20, 30) if k <= len(values)]
    errors = figures.get("expected_error", {}).items()
    typer.echo(
        f"{figures['filters']} filters, {band[0]:g}-{band[-1]:g} nm, {len(band)} bands\n"
        f"mean transmittance              {figures['throughput']:.3f}\n"
        f"mean |correlation| of filters   {figures['mean_correlation']:.3f}\n"
        f"largest cosine, bands 10 nm off {figures['mutual_coherence']:.3f}\n"
        f"peaks per 100 nm                {figures['peak_density']:.2f}\n"
        f"condition number                {figures['condition_number']:.3g}\n"
        f"singular values                 "
        + "  ".join(f"s{k} {values[k - 1]:.2g}" for k in shown)
        + "".join(f"\nexpected error at {name}         {error:.5f}" for name, error in errors)
    )


@app.command()
def design(
    output: Annotated[Path, typer.Option("-o", "--output", help="The array, .toml")],
    recipe: Annotated[str, typer.Option(help="stencil, free or fabry-perot.")] = "stencil",
    snr: SnrOption = None,
    exposure: ExposureOption = None,
    prior: PriorOption = "natural",
    camera: CameraOption = "thesis",
    draws: Annotated[int, typer.Option(help="Arrays drawn at random.")] = 1000,
    starts: Annotated[int, typer.Option(help="How many of the best are improved.")] = 3,
    rounds: Annotated[int, typer.Option(help="Rounds of improvement for each.")] = 8,
    seed: Annotated[
        int, typer.Option(min=0, max=10**9, help="The same seed gives the same array.")
    ] = 0,
    plot: Annotated[Path | None, typer.Option(help="Draw what was gained, .png .pdf .svg")] = None,
    as_json: JsonOption = False,
) -> None:
    """Search for the filters that leave the least error.

    The error is that of linearly reconstructed spectra. Many arrays are drawn at random; from the
    best of them masks are exchanged and thicknesses refined, within the limits of the process.

    Examples: squilla filters design --snr 20 -o array.toml --plot gained.png;
    squilla filters design --recipe free --exposure 1000 -o array.toml
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from squilla.camera.channels import figure_of_merit
    from squilla.camera.design import CameraDesign
    from squilla.cli.checks import check_file
    from squilla.errors import InputError
    from squilla.files.disk import replacing
    from squilla.optics.design import optimise
    from squilla.optics.filters import RECIPES
    from squilla.optics.merit import expected_error, throughput

    if recipe not in RECIPES:
        raise InputError(f"There is no recipe {recipe!r}; there are {', '.join(RECIPES)}.")
    check_file(output, (".toml",))
    if plot is not None:
        check_file(plot, (".png", ".pdf", ".svg"))
    paper = CameraDesign.load(camera)
    known, noise, efficiency = figure_of_merit(paper, prior, snr, exposure)
    band = known.wavelength
    with Progress(
        TextColumn("{task.description:8s}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TextColumn("error {task.fields[error]:.5f}"),
        console=Console(stderr=True),
    ) as bar:  # fmt: skip
        tasks: dict = {}

        def progress(stage: str, done: int, of: int, best: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=of, error=best)
            bar.update(tasks[stage], completed=done, error=best)

        found = optimise(
            RECIPES[recipe](filters=paper.channels),
            lambda response: expected_error(response * efficiency, known, noise=noise),
            band,
            draws=draws,
            starts=starts,
            rounds=rounds,
            seed=seed,
            progress=progress,
        )
    found.array.save(output)
    if plot is not None:
        from squilla.optics.plots import plot_search

        figure = plot_search(found, band, f"{recipe}, {noise}")
        with replacing(plot) as temporary:
            figure.savefig(temporary, format=plot.suffix[1:].lower(), dpi=150)
    figures = {
        "median_drawn": float(found.drawn.median()),
        "best_drawn": float(found.drawn.min()),
        "expected_error": found.merit,
        "throughput": float(throughput(found.array.transmittance(band))),
    }
    if as_json:
        typer.echo(json.dumps(figures))
        return
    typer.echo(
        f"expected error, median of {draws} drawn  {figures['median_drawn']:.5f}\n"
        f"best of {draws} drawn                    {figures['best_drawn']:.5f}\n"
        f"optimised                           {figures['expected_error']:.5f}\n"
        f"mean transmittance                  {figures['throughput']:.3f}\n"
        f"written to {output}"
    )


@app.command()
def tolerance(
    filters: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="A built-in camera, or an array, .toml")
    ],
    scale: Annotated[float, typer.Option(help="Of all thicknesses together, %.")] = 0.0,
    deposition: Annotated[float, typer.Option(help="Of each deposition, %.")] = 0.0,
    layer: Annotated[float, typer.Option(help="Of each layer of each filter, %.")] = 0.0,
    misalignment: Annotated[
        float, typer.Option(help="Of the masks, % of a filter's area left bare.")
    ] = 0.0,
    index: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=NAME", help="A material that turns out to be another."),
    ] = None,
    snr: SnrOption = None,
    exposure: ExposureOption = None,
    prior: PriorOption = "natural",
    camera: CameraOption = "thesis",
    count: Annotated[int, typer.Option(min=1, help="How often the array is coated.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Of the random faults.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Print what faults of the coating cost.

    Once to the estimator of the array as designed, once after calibrating anew. Faults are standard
    deviations. Without any, each is tried alone at 1 %.

    Examples: squilla filters tolerance array.toml;
    squilla filters tolerance array.toml --deposition 0.5 --index TiO2/Franta=TiO2/Siefke
    """
    from dataclasses import replace

    import torch

    from squilla.camera.channels import figure_of_merit
    from squilla.camera.design import CameraDesign
    from squilla.errors import InputError
    from squilla.optics.filters import FilterArray
    from squilla.optics.tolerance import ProcessErrors
    from squilla.optics.tolerance import tolerance as coat

    array, _ = _filters(filters)
    if not isinstance(array, FilterArray):
        raise InputError(f"{filters} is a table of responses; faults need the layers of a .toml.")
    known, noise, efficiency = figure_of_merit(CameraDesign.load(camera), prior, snr, exposure)
    sizes = {
        "scale": scale / 100,
        "deposition": deposition / 100,
        "layer": layer / 100,
        "misalignment": misalignment / 100,
    }
    if not all(name.count("=") == 1 for name in index or []):
        raise InputError(f"--index is {index}; expected NAME=NAME, TiO2/Franta=TiO2/Siefke.")
    swapped = dict(name.split("=") for name in index or [])
    if swapped or any(sizes.values()):
        cases = {"all together": ProcessErrors(**sizes, index=swapped)}
    else:
        cases = {f"{name} 1 %": replace(ProcessErrors(), **{name: 0.01}) for name in sizes}
    figures = {}
    for name, errors in cases.items():
        generator = torch.Generator().manual_seed(seed)
        found = coat(
            array, errors, known, noise=noise, efficiency=efficiency, count=count,
            generator=generator,
        )  # fmt: skip
        figures[name] = {
            "nominal": found.nominal,
            **{
                kind: getattr(found, kind).quantile(torch.tensor([0.5, 0.95]).double()).tolist()
                for kind in ("change", "fixed", "recalibrated")
            },
        }
    if as_json:
        typer.echo(json.dumps(figures))
        return
    nominal = next(iter(figures.values()))["nominal"]
    typer.echo(
        f"expected error as designed {nominal:.5f} ({noise})\n"
        f"coated {count} times, median (95 % of cases below)\n"
        f"{'':18s}{'change of R':>20s}{'fixed estimator':>22s}{'calibrated anew':>22s}"
    )
    for name, row in figures.items():
        change = "{:.1%} ({:.1%})".format(*row["change"])
        factors = [
            "x{:.2f} (x{:.2f})".format(*(value / nominal for value in row[kind]))
            for kind in ("fixed", "recalibrated")
        ]
        typer.echo(f"{name:18s}{change:>20s}{factors[0]:>22s}{factors[1]:>22s}")


def _filters(
    name: str, *, seed: int | None = None, wavelength: "np.ndarray | None" = None
) -> "tuple[FilterArray | MeasuredFilters, np.ndarray]":
    """Return the filters of a built-in camera or of a file, and the band to judge them in, nm."""
    from squilla.camera.channels import filters_of
    from squilla.camera.design import CameraDesign
    from squilla.errors import InputError
    from squilla.optics.filters import FilterArray, read_filters
    from squilla.spectra import grid

    path = Path(name)
    design = path.suffix == ".toml" and path.is_file() and "[array]" in path.read_text("utf-8")
    if path.suffix and not design:
        if seed is not None:
            raise InputError(f"--seed draws the filters of a camera; those of {name} are drawn.")
        array = read_filters(name, wavelength=wavelength)
        return array, grid() if isinstance(array, FilterArray) else array.wavelength
    if wavelength is not None:
        raise InputError(
            f"--wavelength is for a table of filters; the camera {name} knows its own."
        )
    camera = CameraDesign.load(name)
    if seed is not None:
        drawn = {"seed": seed}
        camera = camera.model_copy(update={"filters": camera.filters.model_copy(update=drawn)})
    return filters_of(camera), camera.wavelength
