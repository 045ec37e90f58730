"""``squilla export-model``: a network for other programs."""

from pathlib import Path
from typing import Annotated

import typer


def export_model(
    calibration: Annotated[Path, typer.Option(help="Of the camera, .nc.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="ONNX file to write.")],
    model: Annotated[str, typer.Option(help="A name of `squilla models`, or a file.")] = "mlp",
) -> None:
    """Write a network as ONNX, for other programs.

    ONNX Runtime, OpenVINO and phones read it.

    It takes measurements divided by their maximum, (N, filters), and gives spectra before their
    scale is restored. `compound` is no network and stays here.

    Example: squilla export-model --calibration camera.nc --model respecnn.safetensors -o net.onnx
    """
    from squilla.calibration.store import load_calibration
    from squilla.reconstruction.models import load_model

    load_model(model, load_calibration(calibration)).export(output)
    typer.echo(f"{output}: `{model}`")
