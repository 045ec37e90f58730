"""``squilla train``: weights for a camera of one's own."""

import json
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from squilla.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from squilla.training.noise import Noise


def train(
    calibration: Annotated[Path, typer.Option(help="Calibration of the camera, .nc.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Model file to write.")],
    model: Annotated[str, typer.Option(help="Network, or compound; see `squilla models`.")] = "mlp",
    noise: Annotated[
        str,
        typer.Option(
            help="none; 20 or 15:20 (dB, drawn evenly); or a camera whose sensor makes it: "
            "thesis, FILE.toml."
        ),
    ] = "15:20",
    gain_error: Annotated[
        float, typer.Option(help="Deviation of random factors on each channel's sensitivity.")
    ] = 0.0,
    dropped: Annotated[float, typer.Option(help="Probability that a channel is lost.")] = 0.0,
    spectra: Annotated[str, typer.Option(help="Prior: broad, gaussian, natural, line.")] = "broad",
    count: Annotated[
        int | None, typer.Option(help="Spectra in an epoch; 8000, of compound 60000.")
    ] = None,
    epochs: Annotated[int, typer.Option(help="Passes over as many spectra.")] = 500,
    batch: Annotated[int, typer.Option(help="Spectra in a step.")] = 1024,
    learning_rate: Annotated[float, typer.Option(help="Of Adam.")] = 1e-4,
    schedule: Annotated[str, typer.Option(help="constant or cosine.")] = "constant",
    fresh: Annotated[bool, typer.Option(help="New spectra for every epoch.")] = True,
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Same seed, same weights.")] = 0,
    device: Annotated[str | None, typer.Option(help="cpu or cuda; default: what is there.")] = None,
    precision: Annotated[str, typer.Option(help="float32, tf32 or bfloat16.")] = "float32",
    log: Annotated[Path | None, typer.Option(help="Metrics, one line of JSON per epoch.")] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="State to go on from after an interruption.")
    ] = None,
    look: Annotated[
        Path | None, typer.Option(help="Picture of some spectra, drawn anew while it learns.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a network for a calibrated camera, or learn a prior.

    With `--model compound` the prior is learnt on the wavelengths of the camera.

    Example: squilla train --calibration camera.nc --model respecnn -o model.safetensors

    On several GPUs: torchrun --nproc-per-node 4 --no-python squilla train ...
    """
    import squilla
    from squilla.cli.checks import check_file
    from squilla.files.disk import replacing

    check_file(output)
    if look is not None:
        check_file(look, (".png", ".svg", ".pdf", ".webp"))
    known = squilla.load_calibration(calibration)

    def draw(epoch: int, truth: "Tensor", found: "Tensor") -> None:
        from squilla.evaluation.plots import spectra_figure

        assert look is not None
        names = [f"held out {number + 1}" for number in range(len(truth))]
        estimates = {f"{model}, epoch {epoch + 1}": found.numpy()}
        figure = spectra_figure(known.wavelength, truth.numpy(), estimates, names, columns=3)
        with replacing(look) as temporary:
            figure.savefig(temporary, format=look.suffix[1:].lower())

    trained = squilla.train(
        model,
        known,
        noise=parse_noise(noise),
        gain_error=gain_error,
        dropped=dropped,
        spectra=spectra,
        count=count,
        fresh=fresh,
        epochs=epochs,
        batch=batch,
        learning_rate=learning_rate,
        schedule=schedule,  # pyright: ignore[reportArgumentType] (checked there)
        seed=seed,
        device=device,
        precision=precision,  # pyright: ignore[reportArgumentType] (checked there)
        log=log,
        checkpoint=checkpoint,
        look=draw if look is not None else None,
        progress=not as_json,
    )
    if os.environ.get("RANK", "0") != "0":  # of several processes the first one tells
        return
    trained.save(output)
    if as_json:
        typer.echo(json.dumps({"model": model, "file": str(output), **trained.provenance}))
    elif "validation" in trained.provenance:
        error = trained.provenance["validation"]
        typer.echo(f"{output}: {model}, validation error {error:.5f}")
    else:
        typer.echo(f"{output}: {model}, learnt from {trained.provenance['count']} spectra")


def parse_noise(text: str) -> "Noise":
    """Read "none", "20", "15:20" (dB), or the camera whose sensor makes the noise."""
    if text == "none":
        return None
    if text == "thesis" or text.endswith(".toml"):
        from squilla.camera.design import CameraDesign
        from squilla.training.noise import SensorNoise

        return SensorNoise.of(CameraDesign.load(text).sensor)
    try:
        values = [float(part) for part in text.split(":")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= 2 or values != sorted(values) or not all(map(math.isfinite, values)):
        raise InputError(
            f"The noise {text!r} was not understood; write none, 20 or 15:20 (dB), or a camera."
        )
    return values[0] if len(values) == 1 else (values[0], values[1])
