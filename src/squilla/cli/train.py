"""``squilla train``: weights for a camera of one's own."""

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from squilla.errors import InputError


def train(
    calibration: Annotated[Path, typer.Option(help="Calibration of the camera, .nc.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Model file to write.")],
    model: Annotated[str, typer.Option(help="Network, or compound; see `squilla models`.")] = "mlp",
    noise: Annotated[str, typer.Option(help="none, 20 or 15:20 (dB, drawn evenly).")] = "15:20",
    spectra: Annotated[str, typer.Option(help="Prior: broad, gaussian, natural, line.")] = "broad",
    count: Annotated[int, typer.Option(help="Spectra in an epoch.")] = 8000,
    epochs: Annotated[int, typer.Option(help="Passes over as many spectra.")] = 500,
    batch: Annotated[int, typer.Option(help="Spectra in a step.")] = 1024,
    learning_rate: Annotated[float, typer.Option(help="Of Adam.")] = 1e-4,
    schedule: Annotated[str, typer.Option(help="constant or cosine.")] = "constant",
    fresh: Annotated[bool, typer.Option(help="New spectra for every epoch.")] = True,
    seed: Annotated[int, typer.Option(help="Same seed, same weights.")] = 0,
    device: Annotated[str | None, typer.Option(help="cpu or cuda; default: what is there.")] = None,
    log: Annotated[Path | None, typer.Option(help="Metrics, one line of JSON per epoch.")] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="State to go on from after an interruption.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a network for a calibrated camera.

    Example: squilla train --calibration camera.nc --model respecnn -o model.safetensors
    """
    import squilla

    if not output.resolve().parent.is_dir():  # said now, not after an hour of training
        raise InputError(f"There is no folder {output.resolve().parent}; make it first.")
    trained = squilla.train(
        model,
        squilla.load_calibration(calibration),
        noise=parse_noise(noise),
        spectra=spectra,
        count=count,
        fresh=fresh,
        epochs=epochs,
        batch=batch,
        learning_rate=learning_rate,
        schedule=schedule,  # pyright: ignore[reportArgumentType] (checked there)
        seed=seed,
        device=device,
        log=log,
        checkpoint=checkpoint,
        progress=not as_json,
    )
    trained.save(output)
    if as_json:
        typer.echo(json.dumps({"model": model, "file": str(output), **trained.provenance}))
    else:
        error = trained.provenance["validation"]
        typer.echo(f"{output}: {model}, validation error {error:.5f}")


def parse_noise(text: str) -> float | tuple[float, float] | None:
    """Read "none", "20" or "15:20" (dB)."""
    if text == "none":
        return None
    try:
        values = [float(part) for part in text.split(":")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= 2 or values != sorted(values) or not all(map(math.isfinite, values)):
        raise InputError(f"The noise {text!r} was not understood; write none, 20 or 15:20 (dB).")
    return values[0] if len(values) == 1 else (values[0], values[1])
