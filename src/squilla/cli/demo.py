"""``squilla demo``: all the steps from scene to verdict."""

import json
from pathlib import Path
from typing import Annotated

import typer


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    camera: Annotated[str, typer.Option(help="A built-in design, or a TOML file.")] = "thesis",
    snr: Annotated[float, typer.Option(help="Of the captures, dB.")] = 20.0,
    distance: Annotated[float, typer.Option(help="Of the scenes, mm.")] = 300.0,
    seed: Annotated[int, typer.Option(min=0, max=10**9, help="Of all noise.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
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
