"""``squilla camera``, ``rehearse`` and ``models``: what is there to work with."""

import csv
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from squilla.calibration.rehearsal import Rehearsal
    from squilla.camera.design import CameraDesign


def camera(
    design: Annotated[str, typer.Argument(help="A built-in design, or a TOML file.")] = "thesis",
    toml: Annotated[bool, typer.Option("--toml", help="Print the design to start from.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print every figure as JSON.")] = False,
) -> None:
    """Show and check a camera design.

    Example: squilla camera thesis --toml > mine.toml; squilla camera mine.toml
    """
    from squilla.camera.design import CameraDesign, design_path, designs

    read = CameraDesign.load(design)
    if toml:
        typer.echo(design_path(design).read_text(encoding="utf-8"), nl=False)
        return
    if as_json:
        typer.echo(read.model_dump_json(indent=2))
        return
    size, band, sensor = read.field.size, read.band, read.sensor
    filters, single = read.filters, read.filters.layout != "array"
    rows = {
        "camera": read.name,
        "units": "one lens"
        if single
        else f"{read.array.rows} x {read.array.columns}, {read.pitch:.1f} px apart",
        "sub-images": f"{size} x {size} px, {len(read.wavelength)} bands "
        f"{band.start:g}-{band.stop:g} nm",
        "sensor": f"{sensor.columns} x {sensor.rows} px of {sensor.pixel:g} um, {sensor.bits} bit, "
        f"{sensor.gain:.2f} e-/DN",
        "lens": f"f {read.lens.focal_length / 1000:g} mm, "
        f"F/{read.lens.focal_length / read.lens.diameter:g}",
        "filters": f"{read.channels} ({filters.layout}), "
        + (
            f"{filters.recipe} recipe, seed {filters.seed}"
            if filters.recipe
            else f"table {filters.table}"
        ),
        "stop": _barriers(read),
        "effects off": ", ".join(k for k, on in read.effects.model_dump().items() if not on)
        or "none",
        "built in": ", ".join(designs()),
    }
    for name, value in rows.items():
        typer.echo(f"{name:<12} {value}")


def _barriers(design: "CameraDesign") -> str:
    """Say what keeps the sub-images apart."""
    stop, walls, barriers = design.stop, design.walls, []
    if stop is not None:
        shape = "round" if stop.round else "square"
        barriers.append(f"{stop.width:g} mm {shape} at {stop.distance:g} mm")
    if walls is not None:
        barriers.append(f"walls of {walls.height / 1000:g} mm")
    if not barriers and design.units > 1:
        return "none: sub-images overlap"
    return ", ".join(barriers) or "none needed"


def rehearse(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    camera: Annotated[str, typer.Option(help="A built-in design, or a TOML file.")] = "thesis",
    step: Annotated[float, typer.Option(help="Of the sweep, nm.")] = 5.0,
    frames: Annotated[int, typer.Option(min=2, help="Darks and flats of each exposure.")] = 8,
    distance: Annotated[float, typer.Option(help="Of the poster, mm.")] = 300.0,
    power_error: Annotated[float, typer.Option(help="Of the reference detector, relative.")] = 0.0,
    known: Annotated[
        bool, typer.Option("--known", help="Also a chart of known spectra under five lamps.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Of all noise.")] = 0,
) -> None:
    """Let the twin take the frames that a calibration wants.

    Example: squilla rehearse -o frames
    """
    from rich.progress import track

    from squilla.calibration.rehearsal import Rehearsal
    from squilla.camera.twin import Camera
    from squilla.cli.checks import check_distance, make_folder
    from squilla.errors import InputError
    from squilla.files.disk import replacing
    from squilla.files.raw import write_raw

    if not (0.01 <= step < math.inf and 0 <= power_error < 1):
        raise InputError(
            f"A step of {step:g} nm and a power error of {power_error:g} make no sweep; give a "
            "step of 0.01 nm or more and an error from 0 to below 1."
        )
    check_distance(distance)
    twin = Camera(camera)
    rehearsal = Rehearsal(
        twin, seed=seed, frames=frames, step=step, bandwidth=step,
        power_error=power_error, distance=distance,
    )  # fmt: skip
    target = rehearsal.target()  # first, for it says whether the distance can be
    for folder in ("dark", "flat", "sweep"):
        make_folder(output / folder)
    for number, raw in enumerate(track(rehearsal.dark(), "darks", total=2 * frames)):
        write_raw(output / "dark" / f"{number:03d}.tiff", raw)
    for number, raw in enumerate(track(rehearsal.flat(), "flats", total=frames)):
        write_raw(output / "flat" / f"{number:03d}.tiff", raw)
    table = [("file", "wavelength", "power", "bandwidth")]
    count = len(rehearsal.wavelengths)
    for number, one in enumerate(track(rehearsal.sweep(), "sweep", total=count)):
        name = f"{number:03d}.tiff"
        write_raw(output / "sweep" / name, one.raw)
        table.append((name, f"{one.wavelength:g}", f"{one.power:.6g}", f"{one.bandwidth:g}"))
    with (
        replacing(output / "sweep" / "sweep.csv") as temporary,
        temporary.open("w", newline="", encoding="utf-8") as stream,
    ):
        csv.writer(stream).writerows(table)
    write_raw(output / "target.tiff", target)
    if known:
        _write_known(rehearsal, output / "known")
    typer.echo(
        f"{output}: now run\n  squilla calibrate --camera {camera} --dark {output}/dark "
        f"--flat {output}/flat --sweep {output}/sweep --target {output}/target.tiff "
        f"--target-distance {distance:g} -o camera.nc"
    )


def _write_known(rehearsal: "Rehearsal", folder: Path) -> None:
    """Write frames of known surfaces as `squilla calibrate --known` reads them."""
    import numpy as np
    from PIL import Image

    from squilla.files.raw import write_raw

    folder.mkdir(exist_ok=True)
    wavelength = rehearsal.camera.design.wavelength
    table = [("file", "spectra", "labels", "distance")]
    for number, scene in enumerate(rehearsal.known()):
        row = (f"{number:03d}.tiff", f"{number:03d}.txt", "labels.png", f"{scene.distance:g}")
        write_raw(folder / row[0], scene.raw)
        np.savetxt(folder / row[1], np.vstack([wavelength, scene.spectra]).T, fmt="%.7g")
        Image.fromarray((scene.labels + 1).astype(np.uint8)).save(folder / row[2])
        table.append(row)
    with (folder / "known.csv").open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows(table)


def models(
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """List the reconstructors.

    Example: squilla models
    """
    from squilla.reconstruction.models import models

    if as_json:
        typer.echo(json.dumps(models(), indent=2))
        return
    for name, line in models().items():
        typer.echo(f"{name:<10} {line}")
