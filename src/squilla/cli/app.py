"""Every command in one place; each loads what it needs when it runs."""

from typing import Annotated

import typer

from squilla import __version__
from squilla.cli import camera, cameras, filters, sweep, twin
from squilla.cli.align import align
from squilla.cli.calibrate import calibrate, check
from squilla.cli.demo import demo
from squilla.cli.evaluate import evaluate
from squilla.cli.export import export_model
from squilla.cli.reconstruct import reconstruct
from squilla.cli.train import train
from squilla.cli.view import live, view

app = typer.Typer(
    name="squilla",
    help="Snapshot computational hyperspectral cameras: design, simulate, calibrate, reconstruct.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command()(demo)
app.command()(camera.camera)
app.add_typer(filters.app, name="filters")
app.command()(twin.simulate)
app.command()(twin.rehearse)
app.command()(calibrate)
app.command()(train)
app.command()(align)
app.command()(check)
app.command()(reconstruct)
app.command()(evaluate)
app.add_typer(sweep.app, name="sweep")
app.command()(view)
app.command()(live)
app.command()(cameras.cameras)
app.command()(cameras.grab)
app.command(name="twin-camera")(cameras.twin_camera)
app.command()(camera.models)
app.command(name="export-model")(export_model)


@app.callback(invoke_without_command=True)
def _main(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(f"squilla {__version__}")
        raise typer.Exit
