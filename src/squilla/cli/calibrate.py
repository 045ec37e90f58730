"""``squilla calibrate`` and ``check``: learn a camera, and whether it still is the one learnt."""

import json
from pathlib import Path
from typing import Annotated

import typer

from squilla.errors import InputError

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def calibrate(
    output: Annotated[Path, typer.Option("-o", "--output", help="Calibration to write, .nc.")],
    dark: Annotated[Path, typer.Option(help="Frames without light: a file or folder.")],
    flat: Annotated[Path, typer.Option(help="Frames of an even white: a file or folder.")],
    sweep: Annotated[
        Path | None, typer.Option(help="Folder with narrow-band flats and sweep.csv.")
    ] = None,
    known: Annotated[
        Path | None, typer.Option(help="Instead: folder with known surfaces and known.csv.")
    ] = None,
    target: Annotated[Path | None, typer.Option(help="Frame of a textured plane.")] = None,
    target_distance: Annotated[float | None, typer.Option(help="Its distance, mm.")] = None,
    shots: Annotated[
        Path | None, typer.Option(help="Folder with hand-held shots of a textured plane.")
    ] = None,
    camera: Annotated[str, typer.Option(help="A built-in design, or a TOML file.")] = "thesis",
    as_json: Json = False,
) -> None:
    """Learn a camera from its frames.

    sweep.csv has the columns file, wavelength (nm), power (photon radiance of the light) and
    bandwidth (nm, full width at half maximum).

    Without a monochromator: known.csv has the columns file (a frame), spectra (a text file: a
    column of wavelengths in nm, then the photon radiance of each surface), labels (a picture of
    the reference view: 1 where it shows the first surface, 0 where none) and distance (mm).

    Example: squilla calibrate --dark dark --flat flat --sweep sweep --target target.tiff
    --target-distance 300 -o camera.nc
    """
    from rich.progress import track

    from squilla.calibration.calibrate import calibrate
    from squilla.calibration.lessons import read_known, read_sweep
    from squilla.camera.design import CameraDesign
    from squilla.cli.checks import check_file
    from squilla.files.raw import read_raw, read_raws

    check_file(output, (".nc",))
    if target is None and shots is None and target_distance is not None:
        raise InputError("--target-distance is the distance of the --target; give both or none.")
    design = CameraDesign.load(camera)
    steps = None if sweep is None else read_sweep(sweep)
    scenes = None if known is None else read_known(known, design.wavelength)
    calibration = calibrate(
        design,
        dark=track(read_raws(dark), "darks", disable=as_json),
        flat=track(read_raws(flat), "flats", disable=as_json),
        sweep=None if steps is None else track(steps, "sweep", disable=as_json),
        known=None if scenes is None else track(scenes, "known scenes", disable=as_json),
        target=None if target is None else read_raw(target),
        target_distance=target_distance,
        shots=() if shots is None else read_raws(shots),
    )
    calibration.save(output)
    if as_json:
        typer.echo(json.dumps({"file": str(output), **calibration.provenance}))
        return
    pixels = calibration.pixels
    assert pixels is not None
    typer.echo(
        f"{output}: {calibration.filters} filters, {len(calibration.wavelength)} bands, "
        f"{len(calibration.angle)} field angles; {pixels.gain:.2f} e-/DN, read noise "
        f"{pixels.read_noise:.1f} e-, {calibration.provenance['bad_pixels']} bad pixels"
    )
    for name in ("saturated_steps", "doubted_steps"):
        left_out = calibration.provenance.get(name, "none")
        if left_out != "none":
            typer.echo(f"  left out, {name.removesuffix('_steps')}: {left_out}")


def check(
    calibration: Annotated[Path, typer.Argument(help="Of the camera, .nc.")],
    dark: Annotated[Path, typer.Option(help="Today's frames without light: a file or folder.")],
    flat: Annotated[Path, typer.Option(help="Today's flats in the calibration's lamp.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Calibration to write, mended, .nc.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare darks and flats of today with a calibration.

    Finds dust, hot pixels and moved filters.

    Example: squilla check camera.nc --dark dark --flat flat -o camera-today.nc
    """
    from squilla.calibration.check import check
    from squilla.calibration.store import load_calibration
    from squilla.files.raw import read_raws

    known = load_calibration(calibration)
    found = check(known, dark=read_raws(dark), flat=read_raws(flat))
    if output is not None:
        found.mended(known).save(output)
    if as_json:
        told = ("drift", "drift_error", "lamp", "dusty", "hot", "dark_risen")
        figures = {name: getattr(found, name) for name in told}
        typer.echo(json.dumps(figures | {"response": found.response.tolist(), "says": found.says}))
        return
    for sentence in found.says or ["Nothing has changed."]:
        typer.echo(sentence)
