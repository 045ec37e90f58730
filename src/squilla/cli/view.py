"""``squilla view`` and ``squilla live``: cubes, and a camera, in a browser."""

import math
import webbrowser
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from squilla.errors import InputError

if TYPE_CHECKING:
    from squilla.live.server import Source

Host = Annotated[
    str,
    typer.Option(help="Address to bind; one that others can reach demands a token."),
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="0 for any that is free.")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page.")]


def view(
    cube: Annotated[list[Path], typer.Argument(help=".nc .hdr .zarr .tiff .npz .npy .mat")],
    reference: Annotated[
        list[Path] | None, typer.Option(help="Table of wavelengths and spectra, .csv or .txt.")
    ] = None,
    variable: Annotated[
        str | None, typer.Option(help="Name of the cube where a file holds several.")
    ] = None,
    wavelength: Annotated[
        Path | None, typer.Option(help="List of wavelengths, nm, where a file has none.")
    ] = None,
    memory: Annotated[float, typer.Option(help="Cubes above so many GB are read by need.")] = 1.0,
    host: Host = "127.0.0.1",
    port: Port = 8750,
    browser: Browser = True,
) -> None:
    """Look at cubes: colour, bands, spectra, maps.

    Example: squilla view doll.nc --reference paints.csv
    """
    from threading import Thread

    from squilla.live.reference import read_references
    from squilla.live.server import Broken
    from squilla.live.stored import StoredCube

    if not 0 <= memory < math.inf:
        raise InputError(f"The memory must be a number of GB, 0 or more, not {memory:g}.")
    sources: list[Source] = []
    for path in cube:
        try:
            sources.append(
                StoredCube.open(
                    path, held=int(memory * 1e9), variable=variable, wavelength=wavelength
                )
            )
        except InputError as error:
            if len(cube) == 1:
                raise
            typer.echo(f"squilla: {error}", err=True)
            sources.append(Broken(path.name, str(error)))
    if all(isinstance(source, Broken) for source in sources):
        raise InputError("None of these files is a cube.")
    first = next(source for source in sources if isinstance(source, StoredCube))
    Thread(target=first.warm, daemon=True).start()  # while the page opens
    spectra = [one for path in reference or () for one in read_references(path)]
    show(sources, host=host, port=port, browser=browser, references=spectra)


def show(
    sources: "list[Source]", *, host: str, port: int, browser: bool, references: list[dict]
) -> None:
    """Serve sources until interrupted, and say where."""
    from squilla.live.server import is_loopback, serve

    def ready(address: str) -> None:
        typer.echo(f"{address}\nCtrl+C ends it.")
        if browser and is_loopback(host):
            webbrowser.open(address)

    serve(sources, host=host, port=port, references=references, ready=ready)


def live(
    calibration: Annotated[Path, typer.Option(help="Of the camera, .nc.")],
    source: Annotated[
        str,
        typer.Option(
            help="twin; genicam:ID as `squilla cameras` tells it, genicam for the first found; "
            "or a folder of raw frames."
        ),
    ] = "twin",
    model: Annotated[str, typer.Option(help="A name of `squilla models`, or a file.")] = "ridge",
    camera: Annotated[
        str, typer.Option(help="The twin's design: built-in, or a TOML file.")
    ] = "thesis",
    scene: Annotated[str, typer.Option(help="What the twin sees: a scene or a file.")] = "chart",
    distance: Annotated[
        float | None, typer.Option(help="Of the scene, mm; default: found from each frame.")
    ] = None,
    exposure: Annotated[
        float | None, typer.Option(help="ms; default: as the camera has it. The page can set it.")
    ] = None,
    gain: Annotated[
        float | None, typer.Option(help="In the camera's unit; use the calibration's.")
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="Where the page records: a folder for raw TIFF, or a new .zarr of cubes."
        ),
    ] = None,
    host: Host = "127.0.0.1",
    port: Port = 8750,
    browser: Browser = True,
) -> None:
    """Look through a live camera in a browser.

    Shows the newest frame, aligned and reconstructed.

    Example: squilla live --source genicam --calibration camera.nc
    """
    import torch

    from squilla.calibration.store import load_calibration
    from squilla.cli.checks import check_distance
    from squilla.live.pipeline import LiveSource
    from squilla.live.record import Recorder
    from squilla.live.source import open_source
    from squilla.reconstruction.models import load_model

    check_distance(distance)
    # A frame is measured while another is reconstructed; threads that wait for cores waste them.
    torch.set_num_threads(max(1, torch.get_num_threads() // 2))
    learnt = load_calibration(calibration)
    reconstructor = load_model(model, learnt)
    recorder = None if record is None else Recorder(record)
    with closing(open_source(source, camera, scene)) as frames:
        if exposure is not None:
            frames.exposure = exposure
        if gain is not None:
            frames.gain = gain
        shown = LiveSource(
            frames, learnt, reconstructor, title=source, recorder=recorder, distance=distance
        )
        with closing(shown):
            show([shown], host=host, port=port, browser=browser, references=[])
