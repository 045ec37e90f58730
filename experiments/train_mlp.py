"""Train the `mlp` that ships: broad prior, uniform noise, one camera.

    python experiments/train_mlp.py --calibration demo/calibration.nc

The network is judged on random spectra that it never saw, beside the linear estimator that knows
the noise; no chart takes part. Interrupted, it goes on where it was when started again. The
defaults are those of the weights that ship; the model file and results/train_mlp.jsonl hold what
they were trained with.
"""

import argparse
from pathlib import Path

import torch

import squilla
from squilla.cli.train import parse_noise
from squilla.priors import PRIORS
from squilla.reconstruction.linear import Ridge
from squilla.training.noise import add_noise

WEIGHTS = Path(squilla.__file__).parent / "data" / "weights" / "mlp.safetensors"
RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description="Train the mlp that ships.")
    parser.add_argument("--calibration", type=Path, required=True, help="camera.nc")
    parser.add_argument("--noise", default="5:40", help="dB; default 5:40")
    parser.add_argument("--epochs", type=int, default=150, help="of 32 768 fresh spectra each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=WEIGHTS)
    parser.add_argument("--work", type=Path, default=RESULTS, help="folder of log and checkpoint")
    options = parser.parse_args()

    calibration = squilla.load_calibration(options.calibration)
    options.work.mkdir(parents=True, exist_ok=True)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    checkpoint = options.work / "train_mlp.checkpoint"
    model = squilla.train(
        "mlp",
        calibration,
        noise=parse_noise(options.noise),
        count=32_768,
        epochs=options.epochs,
        batch=512,
        learning_rate=1e-3,
        schedule="cosine",
        seed=options.seed,
        log=options.work / "train_mlp.jsonl",
        checkpoint=checkpoint,
    )
    model.save(options.output, half=True)
    checkpoint.unlink()
    print(table(squilla.load_model(options.output, calibration), calibration))


@torch.no_grad()
def table(model: squilla.Reconstructor, calibration: squilla.Calibration) -> str:
    """Return the mean squared errors on spectra that no training drew."""
    generator = torch.Generator().manual_seed(20_250_101)
    ridge = Ridge(calibration)
    lines = ["| spectra | SNR, dB | ridge | mlp |", "|---|---|---|---|"]
    for prior in ("natural", "gaussian", "line"):
        spectra = PRIORS[prior](4000, calibration.wavelength, generator=generator)
        outermost = float(calibration.angle[-1])
        angle = outermost * torch.rand(len(spectra), generator=generator).sqrt()
        for snr in (15, 20, 30, 40):
            y = add_noise(calibration.project(spectra, angle), snr, generator)
            errors = [
                float((estimator(y, angle, snr) - spectra).square().mean())
                for estimator in (ridge, model)
            ]
            lines.append(f"| {prior} | {snr} | {errors[0]:.5f} | {errors[1]:.5f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
