"""``squilla simulate`` and ``rehearse``: frames of a camera that exists only as numbers."""

import math
from pathlib import Path
from typing import Annotated

import typer

from squilla.errors import InputError


def simulate(
    scene: Annotated[
        str, typer.Argument(help="chart, indian-pines, corn-kernel, doll, or a file.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Raw frame to write.")],
    camera: Annotated[str, typer.Option(help="A built-in design, or a TOML file.")] = "thesis",
    distance: Annotated[float, typer.Option(help="Of a plane scene, mm.")] = 300.0,
    depth: Annotated[Path | None, typer.Option(help="Depth map, mm: .npy or .tiff.")] = None,
    snr: Annotated[float | None, typer.Option(help="Wanted, dB; default: 20.")] = None,
    exposure: Annotated[float | None, typer.Option(help="ms, instead of an SNR.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Of the noise.")] = 0,
    truth: Annotated[
        Path | None, typer.Option(help="Also write what a perfect camera would see.")
    ] = None,
) -> None:
    """Capture a scene with the twin.

    Example: squilla simulate chart -o raw.tiff --snr 20 --truth truth.nc
    """
    import torch

    from squilla.camera.scenes import load_scene
    from squilla.camera.solid import solid_scene
    from squilla.camera.twin import Camera
    from squilla.cli.checks import check_distance, check_file
    from squilla.files.cube import CUBE_SUFFIXES, save
    from squilla.files.depth import read_depth
    from squilla.files.raw import write_raw

    check_file(output)
    check_distance(distance)
    if truth is not None:
        check_file(truth, CUBE_SUFFIXES)
    if snr is None and exposure is None:
        snr = 20.0
    twin = Camera(camera)
    wavelength, size = twin.design.wavelength, twin.design.field.size
    if scene == "doll":  # brings its own depth
        picture, relief = solid_scene(wavelength, size, distance=distance)
    else:
        picture, relief = load_scene(scene, wavelength, size), None
    if depth is not None:
        relief = read_depth(depth, picture.shape[:2])
    raw = twin.capture(
        picture,
        distance=distance,
        depth=relief,
        snr=snr,
        exposure=exposure,
        generator=torch.Generator().manual_seed(seed),
    )
    write_raw(output, raw)
    if truth is not None:
        save(twin.truth(picture, distance=distance, depth=relief).cube, truth)
    typer.echo(f"{output}: {raw.frame.shape[0]} x {raw.frame.shape[1]} px, {raw.exposure:.3g} ms")


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

    from squilla.calibration.lessons import write_known, write_sweep
    from squilla.calibration.rehearsal import Rehearsal
    from squilla.camera.twin import Camera
    from squilla.cli.checks import check_distance
    from squilla.files.disk import make_folder
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
    for folder in ("dark", "flat"):
        make_folder(output / folder)
    for number, raw in enumerate(track(rehearsal.dark(), "darks", total=2 * frames)):
        write_raw(output / "dark" / f"{number:03d}.tiff", raw)
    for number, raw in enumerate(track(rehearsal.flat(), "flats", total=frames)):
        write_raw(output / "flat" / f"{number:03d}.tiff", raw)
    count = len(rehearsal.wavelengths)
    write_sweep(output / "sweep", track(rehearsal.sweep(), "sweep", total=count))
    write_raw(output / "target.tiff", target)
    if known:
        write_known(output / "known", twin.design.wavelength, rehearsal.known())
    typer.echo(
        f"{output}: now run\n  squilla calibrate --camera {camera} --dark {output}/dark "
        f"--flat {output}/flat --sweep {output}/sweep --target {output}/target.tiff "
        f"--target-distance {distance:g} -o camera.nc"
    )
