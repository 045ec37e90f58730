"""The steps from scene to verdict, one by one on files, and all of them as the demo."""

import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from squilla.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from xarray import DataArray

    from squilla.batch import Recipe
    from squilla.calibration.known import KnownScene
    from squilla.calibration.sensitivity import SweepStep
    from squilla.files.raw import Frame

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    camera: Annotated[str, typer.Option(help="A built-in design, or a TOML file.")] = "thesis",
    snr: Annotated[float, typer.Option(help="Of the captures, dB.")] = 20.0,
    distance: Annotated[float, typer.Option(help="Of the scenes, mm.")] = 300.0,
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Of all noise.")] = 0,
    as_json: Json = False,
) -> None:
    """Send four scenes through the camera and back.

    Writes raw frames, the calibration, cubes, metrics.json and report.html.

    Example: squilla demo -o demo
    """
    from squilla.demo import demo

    metrics = demo(output, camera=camera, snr=snr, distance=distance, seed=seed)
    if as_json:
        typer.echo(json.dumps(metrics))
        return
    for scene, models in metrics.items():
        aligned = models["alignment_rms_px"]
        typer.echo(f"\n{scene}: aligned to {aligned:.3f} px")
        typer.echo(
            f"  {'model':<10}{'MSE':>10}{'RMSE':>10}{'SAM, deg':>10}{'PSNR, dB':>10}{'s':>8}"
        )
        for name, judged in models.items():
            if isinstance(judged, dict):
                typer.echo(
                    f"  {name:<10}{judged['mse']:>10.5f}{judged['rmse']:>10.4f}"
                    f"{judged['sam_deg']:>10.2f}{judged['psnr_db']:>10.2f}{judged['seconds']:>8.2f}"
                )
    typer.echo(f"\n{output / 'report.html'}")


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
        typer.Option(help="Runs the networks: torch, openvino, openvino-bf16, onnxruntime, cuda."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes for many frames; default: every core.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Of a Dask cluster for many frames, tcp://host:8786.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Turn raw frames into hyperspectral cubes.

    Many frames go into a folder, a NetCDF file each, or into one .zarr along a dimension
    "capture". A run that was interrupted goes on where it was when it is started again.

    Examples: squilla reconstruct raw.tiff --calibration camera.nc --model ridge -o cube.nc;
    squilla reconstruct night/ --calibration camera.nc --model mlp -o night.zarr
    """
    from squilla.batch import Recipe, reconstruct_one
    from squilla.cli.checks import check_distance, check_file
    from squilla.files.cube import CUBE_SUFFIXES, save
    from squilla.files.raw import list_frames

    check_distance(distance)

    frames = [frame for path in raw for frame in list_frames(path)]
    recipe = Recipe(calibration, model, distance, depth, engine)
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
    if engine is not None:
        away = cube.attrs["model_engine_error"]
        typer.echo(f"  {engine}: {away:.1e} from PyTorch in float32 (rms over rms)")


def _reconstruct_many(
    frames: "list[Frame]", recipe: "Recipe", output: Path,
    workers: int | None, scheduler: str | None, as_json: bool,
) -> None:  # fmt: skip
    from dataclasses import asdict

    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from squilla.batch import reconstruct_all

    columns = TextColumn("captures"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), disable=as_json) as progress:
        bar = progress.add_task("captures", total=len(frames))
        summary = reconstruct_all(
            frames,
            recipe,
            output,
            workers=workers,
            scheduler=scheduler,
            progress=lambda ended, of: progress.update(bar, completed=ended, total=of),
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


def evaluate(
    cube: Annotated[Path, typer.Argument(help="Reconstructed cube.")],
    reference: Annotated[Path | None, typer.Option(help="Cube of the truth.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for a report against the truth.")
    ] = None,
    as_json: Json = False,
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
    from squilla.cli.checks import make_folder
    from squilla.evaluation.report import Trial, scene_section, write_report
    from squilla.files.cube import labelled
    from squilla.files.disk import replacing
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


def read_sweep(folder: Path) -> "Iterator[SweepStep]":
    """Read ``sweep.csv`` in a folder at once, and return an iterator over the frames it lists."""
    from squilla.calibration.sensitivity import SweepStep
    from squilla.files.raw import read_raw

    listed = _listed(folder / "sweep.csv", ("file",), ("wavelength", "power", "bandwidth"))
    return (SweepStep(read_raw(path), *values) for (path,), values in listed)


def read_known(folder: Path, wavelength: "np.ndarray") -> "Iterator[KnownScene]":
    """Read ``known.csv`` in a folder at once, and return an iterator over the scenes it lists."""
    import numpy as np
    from PIL import Image, UnidentifiedImageError

    from squilla.calibration.known import KnownScene
    from squilla.files.raw import read_raw
    from squilla.optics.materials import read_columns
    from squilla.spectra import resample

    listed = _listed(folder / "known.csv", ("file", "spectra", "labels"), ("distance",))

    def scene(paths: list[Path], distance: float) -> KnownScene:
        frame, spectra, labels = paths
        columns = read_columns(spectra).T
        try:
            with Image.open(labels) as picture:
                numbers = np.asarray(picture).astype(int) - 1
        except (OSError, UnidentifiedImageError) as error:
            raise InputError(f"The labels {labels} cannot be read as a picture: {error}.") from None
        values = resample(columns[1:], columns[0], wavelength)
        return KnownScene(read_raw(frame), values, numbers, distance)

    return (scene(paths, distance) for paths, (distance,) in listed)


def _listed(
    table: Path, files: tuple[str, ...], numbers: tuple[str, ...]
) -> list[tuple[list[Path], list[float]]]:
    """Read a table of files beside it and numbers; every file must be there."""
    from squilla.files.disk import existing

    wanted = ", ".join((*files, *numbers))
    try:
        with table.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{table} cannot be read ({error}); wanted is a folder of frames with a table "
            f"{table.name} of {wanted}."
        ) from error
    listed = []
    for line, row in enumerate(rows, 2):
        try:
            paths = [table.parent / row[name] for name in files]
            values = [float(row[name]) for name in numbers]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{table}, line {line}: wanted are {wanted}.") from error
        listed.append(([existing(path) for path in paths], values))
    return listed


def read_depth(path: Path, shape: tuple[int, ...]) -> "np.ndarray":
    """Read a depth map, mm, and cut and resize it as `fitted` does the scene, (y, x) float64."""
    import numpy as np

    from squilla.files.disk import existing, reading
    from squilla.files.tiff import read_pages

    with reading(existing(path), "depth map"):
        if path.suffix.lower() == ".npy":
            depth = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
        else:
            depth = read_pages(path)
    depth = depth[0] if depth.ndim == 3 and len(depth) == 1 else depth
    if depth.ndim != 2 or depth.size == 0 or depth.dtype.kind not in "uif":
        raise InputError(f"The depth map {path} must be one picture of distances in mm.")
    if depth.shape != tuple(shape):
        from scipy.ndimage import zoom

        side = min(depth.shape)
        top, left = ((length - side) // 2 for length in depth.shape)
        square = depth[top : top + side, left : left + side].astype(float)
        factor = np.divide(shape, side)
        depth = np.asarray(zoom(square, factor, order=1, mode="nearest", grid_mode=True))
    return depth.astype(float)
