"""``squilla reconstruct``: raw frames into cubes, one or thousands."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from squilla.errors import InputError

if TYPE_CHECKING:
    from squilla.batch.captures import Recipe
    from squilla.files.raw import Frame


def reconstruct(
    raw: Annotated[list[Path], typer.Argument(help="Raw frames: files, TIFFs of many, folders.")],
    calibration: Annotated[Path, typer.Option(help="Of the camera, .nc.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Cube (.nc, .hdr, .tiff, .zarr), or a folder.")
    ],
    model: Annotated[str, typer.Option(help="A name of `squilla models`, or a file.")] = "ridge",
    distance: Annotated[
        float | None, typer.Option(help="Of the scene, mm; default: found from it.")
    ] = None,
    depth: Annotated[
        bool, typer.Option("--depth", help="Find the distance of every point; save it too.")
    ] = False,
    engine: Annotated[
        str | None,
        typer.Option(
            help="Runs the networks: torch, openvino, openvino-bf16, onnxruntime, cuda, cuda-bf16."
        ),
    ] = None,
    interval: Annotated[
        bool, typer.Option("--interval", help="Save how far it may be off, 90 %: `compound`.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes for many frames; default: every core.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Of a Dask cluster for many frames, tcp://host:8786.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Turn raw frames into hyperspectral cubes.

    Many frames go into a folder, a NetCDF file each, or into one .zarr along a dimension
    "capture". A run that was interrupted goes on where it was when it is started again.

    Beside each cube lie its layers: what every pixel is worth (residual, flags), its depth, and
    with --interval its uncertainty: nine of ten true values lie within it.

    Examples: squilla reconstruct raw.tiff --calibration camera.nc --model ridge -o cube.nc;
    squilla reconstruct night/ --calibration camera.nc --model mlp -o night.zarr
    """
    from squilla.batch.captures import Recipe, reconstruct_one
    from squilla.cli.checks import check_distance, check_file
    from squilla.files.cube import CUBE_SUFFIXES, save
    from squilla.files.raw import list_frames

    check_distance(distance)

    frames = [frame for path in raw for frame in list_frames(path)]
    recipe = Recipe(calibration, model, distance, depth, engine, interval)
    into = output.is_dir() and output.suffix != ".zarr"
    if len(frames) > 1 or into:
        if not into and output.suffix != ".zarr":
            raise InputError(
                f"For several raw frames {output} must be an existing folder or a .zarr."
            )
        _reconstruct_many(frames, recipe, output, workers, scheduler, as_json)
        return
    check_file(output, CUBE_SUFFIXES)
    cube, extra, told = reconstruct_one(frames[0], recipe)
    save(cube, output, extra=extra)
    if as_json:
        typer.echo(json.dumps({"file": str(output), **told}))
        return
    plane = f"plane at {told['distance']:.0f} mm ({told['alignment']}, agreement "
    relief = f"{told['alignment']}, {told['distance']:.0f} mm in the median (textured "
    typer.echo(
        f"{output}: {told['snr']:.1f} dB, {relief if depth else plane}"
        f"{told['alignment_score']:.2f})"
    )
    if told.get("flagged", 0.0) > 0.01:
        typer.echo(
            f"  {told['flagged']:.0%} of the pixels are not to be believed; see squilla evaluate"
        )
    if engine is not None:
        away = cube.attrs["model_engine_error"]
        typer.echo(f"  {engine}: {away:.1e} from PyTorch in float32 (rms over rms)")


def _reconstruct_many(
    frames: "list[Frame]", recipe: "Recipe", output: Path,
    workers: int | None, scheduler: str | None, as_json: bool,
) -> None:  # fmt: skip
    from dataclasses import asdict

    from squilla.batch.captures import reconstruct_all
    from squilla.cli.checks import counted

    with counted("captures", silent=as_json) as progress:
        summary = reconstruct_all(
            frames, recipe, output, workers=workers, scheduler=scheduler, progress=progress
        )
    if as_json:
        typer.echo(json.dumps(asdict(summary)))
    else:
        typer.echo(
            f"{output}: {len(summary.done)} of {len(frames)} captures"
            + (f", {summary.found} of them from an earlier run" if summary.found else "")
        )
        for name, why in summary.failed.items():
            typer.echo(f"{name}: {why}", err=True)
    if summary.failed:
        raise typer.Exit(1)
