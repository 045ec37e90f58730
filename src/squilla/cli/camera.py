"""``squilla camera`` and ``models``: what is there to work with."""

import json
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
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
