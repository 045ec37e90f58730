"""``squilla evaluate``: what a cube is worth, by itself or against the truth."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from squilla.errors import InputError

if TYPE_CHECKING:
    from xarray import DataArray


def evaluate(
    cube: Annotated[Path, typer.Argument(help="Reconstructed cube.")],
    reference: Annotated[Path | None, typer.Option(help="Cube of the truth.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for a report against the truth.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Judge a cube by its own layers, or against a reference.

    Says where it comes from and what its pixels are worth.
    With a reference, which is brought onto the wavelengths of the cube, metrics.json and
    report.html are written.

    Examples: squilla evaluate cube.nc;
    squilla evaluate cube.nc --reference truth.nc -o verdict
    """
    from squilla.files.cube import load_cube, open_cube

    if (reference is None) != (output is None):
        raise InputError("Give a reference and a folder for the report (-o) together, or neither.")
    opened, layers = open_cube(cube)
    told = _worth(opened.attrs, layers)
    metrics: dict[str, float | None] = {}
    if reference is not None and output is not None:
        metrics = _judged(cube.stem, load_cube(cube), load_cube(reference), output)
    if as_json:
        typer.echo(json.dumps(metrics | {"provenance": told}))
        return
    for name, value in metrics.items():
        typer.echo(f"{name:<10} {'undefined' if value is None else f'{value:.6g}'}")
    for name, value in told.items():
        typer.echo(f"{name:<28} {value:.6g}" if isinstance(value, float) else f"{name:<28} {value}")


def _judged(
    name: str, cube: "DataArray", reference: "DataArray", output: Path
) -> dict[str, float | None]:
    """Write a report of a cube against its reference, and return the metrics."""
    from squilla.evaluation.report import Trial, scene_section, write_report
    from squilla.files.cube import labelled
    from squilla.files.disk import make_folder, replacing
    from squilla.spectra import resample

    own, wanted = (each["wavelength"].values for each in (reference, cube))
    truth = labelled(resample(reference.values, own, wanted), wanted, attributes=reference.attrs)
    trial = Trial(name, truth, {"cube": cube})
    metrics = trial.metrics["cube"]
    # JSON knows no number for what is infinite or undefined.
    kept = {key: value if math.isfinite(value) else None for key, value in metrics.items()}
    make_folder(output)
    with replacing(output / "metrics.json") as temporary:
        temporary.write_text(json.dumps(kept, indent=2) + "\n", encoding="utf-8")
    write_report(output / "report.html", [scene_section(trial)], title=f"{name} judged")
    return kept


def _worth(attributes: dict, layers: "dict[str, DataArray]") -> dict[str, Any]:
    """Return the provenance of a cube, and how many pixels are not to be believed, and why."""
    import numpy as np

    from squilla.reconstruction.judgement import Doubt

    plain = (str, int, float, np.number)
    told = {
        str(key): value.item() if isinstance(value, np.number) else value
        for key, value in attributes.items()
        if key != "long_name" and isinstance(value, plain)
    }
    if "residual" in layers:
        residual = layers["residual"].values
        for share in (50, 95):
            told[f"residual, {share} % below"] = float(np.nanpercentile(residual, share))
    if "flags" in layers:
        flags = layers["flags"].values.astype(int)
        for doubt in Doubt:
            count = int((flags & doubt > 0).sum())
            if count:
                told[f"{doubt.name}".lower()] = f"{count} of {flags.size} pixels: {doubt.meaning}"
        told["believable"] = f"{(flags == 0).mean():.2%} of the pixels"
    return told
