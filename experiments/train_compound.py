"""Train the `compound` model that ships: one model for every camera.

    python experiments/train_compound.py                  # two cores, about an hour
    python experiments/train_compound.py --steps 60000 --scenes 64 --device cuda --seconds 560

The basis and the mixture of spectra are learnt first (a minute and a half), then the network, on
random scenes seen by random cameras. Interrupted, or stopped by --seconds, it goes on where it was
when started again with the same settings. --export writes the weights of the last checkpoint
without training. The log stands in results/train_compound.jsonl.
"""

import argparse
import sys
from dataclasses import fields
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

import squilla
from squilla.files.disk import replacing
from squilla.optics.filters import StencilRecipe
from squilla.reconstruction.prior import Prior
from squilla.spectra import grid
from squilla.training.compound import Recipe, from_checkpoint, learn_prior, train_compound

WEIGHTS = Path(squilla.__file__).parent / "data" / "weights" / "compound.safetensors"
RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description="Train the compound model that ships.")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this time")
    parser.add_argument("--export", action="store_true", help="write the last checkpoint's weights")
    parser.add_argument("--output", type=Path, default=WEIGHTS)
    parser.add_argument("--work", type=Path, default=RESULTS, help="folder of log and checkpoint")
    parser.add_argument("--array", type=int, help="train for this one random array alone")
    for field in fields(Recipe):
        flag = f"--{field.name.replace('_', '-')}"
        parser.add_argument(flag, type=type(field.default), default=field.default)
    options = parser.parse_args()
    recipe = Recipe(**{field.name: getattr(options, field.name) for field in fields(Recipe)})

    array = None
    if options.array is not None:
        response = StencilRecipe().draw(options.array).transmittance(grid()).numpy()
        array = squilla.Calibration.from_sensitivity(response, grid())
    options.work.mkdir(parents=True, exist_ok=True)
    checkpoint = options.work / "train_compound.checkpoint"
    if options.export:
        from_checkpoint(checkpoint, _prior(options.work / "prior.checkpoint")).save(options.output)
        return
    trained = train_compound(
        array,
        recipe,
        prior=_prior(options.work / "prior.checkpoint"),
        device=options.device,
        log=options.work / "train_compound.jsonl",
        checkpoint=checkpoint,
        seconds=options.seconds,
        progress=sys.stdout.isatty(),
    )
    trained.save(options.output)
    print(f"{options.output}: {trained.provenance['trained_steps']} of {recipe.steps} steps")


def _prior(path: Path) -> Prior:
    """Return the prior, learnt only once."""
    if not path.exists():
        with replacing(path) as temporary:
            save_file(learn_prior(grid()).tensors(), temporary)
    return Prior.from_tensors(load_file(path))


if __name__ == "__main__":
    main()
