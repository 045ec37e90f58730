"""``squilla cameras``, ``grab`` and ``twin-camera``: live cameras, one of them without hardware."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from squilla.errors import InputError


def cameras(
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """List the GenICam cameras that answer.

    Each is told with its pixel formats that squilla can read. Looks on all networks and USB ports
    (libaravis), and at the vendors' GenTL producers that GENICAM_GENTL64_PATH lists.

    Example: squilla cameras
    """
    from squilla.live import aravis, gentl

    ways = [aravis.cameras, *([gentl.cameras] if gentl.producers() else [])]
    found, refusals = [], []
    for way in ways:
        try:
            found += way()
        except InputError as error:
            refusals.append(error)
    if len(refusals) == len(ways):
        raise refusals[0]
    for refusal in refusals:
        print(f"squilla: {refusal}", file=sys.stderr)
    rows = [
        {
            "source": info.source,
            "vendor": info.vendor,
            "model": info.model,
            "serial": info.serial,
            "address": info.address,
            "formats": _formats(info.source),
        }
        for info in found
    ]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    if not rows:
        typer.echo("No camera answers. Try `squilla twin-camera` in another window.")
    for row in rows:
        typer.echo(row["source"])
        for name in ("vendor", "model", "serial", "address", "formats"):
            typer.echo(f"  {name:<9} {row[name]}")


def _formats(source: str) -> str:
    """Return the pixel formats of a camera that squilla reads, or why it does not tell."""
    from squilla.live.genicam import open_camera

    try:
        with open_camera(source) as camera:
            return ", ".join(camera.formats)
    except InputError as error:
        return f"unknown: {error}"


def grab(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    source: Annotated[str, typer.Option(help="As `squilla cameras` tells.")] = "genicam:",
    count: Annotated[int, typer.Option(min=1, help="Frames.")] = 8,
    exposure: Annotated[float | None, typer.Option(help="ms.")] = None,
    gain: Annotated[float | None, typer.Option(help="In the camera's unit, mostly dB.")] = None,
    pixel_format: Annotated[str | None, typer.Option("--format", help="Pixel format.")] = None,
    trigger: Annotated[str | None, typer.Option(help="Line that starts each exposure.")] = None,
    timeout: Annotated[float, typer.Option(help="For a frame, s.")] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the counts as JSON.")] = False,
) -> None:
    """Write frames of a live camera as TIFF.

    They serve to calibrate from, or to reconstruct. Each carries its exposure, gain, pixel format,
    number and camera.

    Example: squilla grab --source genicam: --count 8 --exposure 20 -o frames/dark
    """
    from dataclasses import asdict

    from rich.progress import track

    from squilla.files.disk import make_folder
    from squilla.files.raw import write_raw
    from squilla.live.genicam import open_camera

    make_folder(output)
    with open_camera(
        source, pixel_format=pixel_format, report=lambda said: print(said, file=sys.stderr)
    ) as camera:
        if exposure is not None:
            camera.exposure = exposure
        if gain is not None:
            camera.gain = gain
        if trigger is not None:
            camera.trigger = trigger
        for number in track(range(count), "frames"):
            write_raw(output / f"{number:04d}.tiff", camera.read(timeout=timeout))
        counts, who, taken = camera.statistics, str(camera.info), camera.exposure
    if as_json:
        typer.echo(json.dumps(asdict(counts)))
        return
    said = "unknown exposure" if taken is None else f"{taken:g} ms"
    typer.echo(f"{output}: {counts.delivered} frames of {who}, {said}")
    if counts.incomplete or counts.lost:
        typer.echo(f"{counts.incomplete} frames came incomplete and {counts.lost} not at all")


def twin_camera(
    camera: Annotated[str, typer.Option(help="A built-in design, or a TOML file.")] = "thesis",
    scene: Annotated[
        str, typer.Option(help="chart, indian-pines, corn-kernel, a file; white, or dark.")
    ] = "chart",
    distance: Annotated[float, typer.Option(help="Of the scene, mm.")] = 300.0,
    moving: Annotated[bool, typer.Option("--moving", help="Let the scene swing.")] = False,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 5.0,
    lost: Annotated[float, typer.Option(help="Share of packets to lose, 0..1.")] = 0.0,
    address: Annotated[str, typer.Option(help="Of this machine.")] = "127.0.0.1",
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Of the noise.")] = 0,
) -> None:
    """Be a GigE Vision camera that sends what the twin sees.

    Any GenICam client may open it, set its exposure, gain, region, format and trigger. Ctrl-C
    ends it.

    Example: squilla twin-camera --scene chart --fps 5
    """
    import time

    from squilla.camera.twin import Camera
    from squilla.cli.checks import check_distance
    from squilla.live.twin_camera import TwinCamera
    from squilla.live.twin_frames import TwinFrames, views

    check_distance(distance)
    twin = Camera(camera)
    frames = TwinFrames(twin, views(twin, scene, distance, moving=moving), seed)
    with TwinCamera(frames, rate=fps, address=address, lost=lost) as sender:
        typer.echo(f"genicam:{address} shows {scene} by {twin.serial}; Ctrl-C ends it")
        try:
            while True:
                time.sleep(0.2)
                sender.sent  # noqa: B018  raises what went wrong in the sending thread
        finally:
            typer.echo(f"{sender.sent} frames sent")
