"""``squilla sweep``: every combination of settings, on all cores or a cluster."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from squilla.errors import InputError

app = typer.Typer(
    help="Try every combination of settings, on all cores.",
    no_args_is_help=True,
)

Output = Annotated[Path, typer.Option("-o", "--output", help="Folder: table.csv, journal.jsonl.")]
Ratios = Annotated[str, typer.Option(help="Noise, dB: 10,20,30.")]
Seeds = Annotated[int, typer.Option(min=1, help="How often each is tried, with seeds from 0.")]
Camera = Annotated[str, typer.Option(help="A built-in design, or a TOML file.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; default: every core.")]
Scheduler = Annotated[str | None, typer.Option(help="Of a Dask cluster, tcp://host:8786.")]
Json = Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")]


@app.command()
def noise(
    scene: Annotated[list[str], typer.Argument(help="chart, corn-kernel ..., or files.")],
    calibration: Annotated[Path, typer.Option(help="Of the camera, .nc.")],
    output: Output,
    model: Annotated[str, typer.Option(help="Names or files, with commas.")] = "ridge",
    snr: Ratios = "10,20,30,40",
    seeds: Seeds = 1,
    camera: Camera = "thesis",
    distance: Annotated[float, typer.Option(help="Of the scenes, mm.")] = 300.0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """How models bear noise: captures by the twin, reconstructed and judged.

    Example: squilla sweep noise chart --calibration camera.nc --model ridge,compound
    --snr 10,20,30 -o noise
    """
    from squilla.batch import studies
    from squilla.cli.checks import check_distance
    from squilla.files.disk import existing

    check_distance(distance)
    known = existing(calibration).absolute()
    over = {"scene": scene, "model": model.split(","), "snr": _numbers(snr), "seed": range(seeds)}
    fixed = {"camera": camera, "calibration": known, "distance": distance}
    _run(studies.noise, over, fixed, output, workers, scheduler, as_json)


@app.command()
def filters(
    output: Output,
    recipe: Annotated[
        str, typer.Option(help="stencil, free, fabry-perot, with commas.")
    ] = "stencil",
    snr: Ratios = "20,30",
    seeds: Seeds = 4,
    prior: Annotated[str, typer.Option(help="natural, broad, gaussian or line.")] = "natural",
    camera: Camera = "thesis",
    draws: Annotated[int, typer.Option(min=1, help="Arrays drawn at random.")] = 1000,
    starts: Annotated[int, typer.Option(min=1, help="How many of the best are improved.")] = 3,
    rounds: Annotated[int, typer.Option(min=0, help="Rounds of improvement for each.")] = 8,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Search for filters by each recipe, for each noise; every array found is written.

    Example: squilla sweep filters --recipe stencil,fabry-perot --snr 20,30 --seeds 8 -o arrays
    """
    from squilla.batch import studies

    over = {"recipe": recipe.split(","), "snr": _numbers(snr), "seed": range(seeds)}
    fixed = {
        "folder": str(output.absolute()), "camera": camera, "prior": prior,
        "draws": draws, "starts": starts, "rounds": rounds,
    }  # fmt: skip
    _run(studies.filters, over, fixed, output, workers, scheduler, as_json)


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{text!r} is no list of numbers such as 10,20,30.") from None


def _run(
    work: Callable[..., Mapping],
    over: Mapping[str, Sequence[Any]],
    fixed: Mapping[str, Any],
    output: Path,
    workers: int | None,
    scheduler: str | None,
    as_json: bool,
) -> None:
    from squilla.batch.sweep import sweep
    from squilla.cli.checks import counted

    with counted("cases", silent=as_json) as progress:
        rows = sweep(
            work, over, output, fixed=fixed, workers=workers, scheduler=scheduler,
            progress=progress,
        )  # fmt: skip
    failed = [row for row in rows if "failed" in row]
    if as_json:
        typer.echo(json.dumps(rows))
    else:
        typer.echo(f"{output / 'table.csv'}: {len(rows) - len(failed)} of {len(rows)} cases")
        for row in failed:
            case = ", ".join(f"{name} {row[name]}" for name in over)
            typer.echo(f"{case}: {row['failed']}", err=True)
    if failed:
        raise typer.Exit(1)
