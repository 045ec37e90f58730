"""What is swept over: how a model bears noise, and which filters are best."""

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from squilla.errors import InputError

if TYPE_CHECKING:
    from squilla.calibration.calibration import Calibration
    from squilla.camera.twin import Camera


def noise(
    scene: str, model: str, snr: float, seed: int, camera: str, calibration: Path, distance: float
) -> dict[str, float]:
    """Capture a scene with the twin, reconstruct it, and return how far that is from the truth.

    Parameters
    ----------
    scene, model : str
        Names or files, as `load_scene` and `load_model` take them.
    snr : float
        Of the whole picture, dB.
    seed : int
        Of the noise.
    camera : str
        The twin's design.
    calibration : Path
        Of that camera.
    distance : float
        Of the scene, mm; the reconstruction has to find it.

    Returns
    -------
    dict
        The metrics of `squilla.evaluate`, and the exposure, ms.
    """
    import torch

    from squilla.calibration.alignment import measure
    from squilla.camera.scenes import load_scene
    from squilla.evaluation.metrics import evaluate
    from squilla.reconstruction.models import load_model

    twin, known = _camera(camera, calibration)
    picture = load_scene(scene, twin.design.wavelength, twin.design.field.size)
    generator = torch.Generator().manual_seed(seed)
    raw = twin.capture(picture, distance=distance, snr=snr, generator=generator)
    cube = load_model(model, known).reconstruct(measure(raw, known))
    found = evaluate(cube, twin.truth(picture, distance=distance).cube)
    assert raw.exposure is not None
    return {name: float(value) for name, value in found.items()} | {"exposure": raw.exposure}


@lru_cache(maxsize=1)
def _camera(design: str, calibration: Path) -> "tuple[Camera, Calibration]":
    from squilla.calibration.store import load_calibration
    from squilla.camera.twin import Camera

    return Camera(design), load_calibration(calibration)


def filters(
    recipe: str, snr: float, seed: int, folder: str, camera: str, prior: str,
    draws: int, starts: int, rounds: int,
) -> dict[str, float | str]:  # fmt: skip
    """Search for a filter array and write it as TOML into a folder.

    Parameters
    ----------
    recipe : str
        One of `squilla.optics.filters.RECIPES`.
    snr : float
        Noise that it is made for, dB.
    seed, draws, starts, rounds : int
        As in `squilla.optics.design.optimise`.
    folder : str
        Where to write.
    camera : str
        Design whose sensor stands behind the filters.
    prior : str
        Spectra to be seen.

    Returns
    -------
    dict
        The file, the expected error of its array, and the median and best of those drawn.
    """
    from squilla.camera.channels import figure_of_merit
    from squilla.camera.design import CameraDesign
    from squilla.optics.design import optimise
    from squilla.optics.filters import RECIPES
    from squilla.optics.merit import expected_error

    if recipe not in RECIPES:
        raise InputError(f"There is no recipe {recipe!r}; there are {', '.join(RECIPES)}.")
    design = CameraDesign.load(camera)
    known, white, efficiency = figure_of_merit(design, prior, snr)
    found = optimise(
        RECIPES[recipe](filters=design.channels),
        lambda response: expected_error(response * efficiency, known, noise=white),
        known.wavelength,
        draws=draws,
        starts=starts,
        rounds=rounds,
        seed=seed,
    )
    path = Path(folder) / f"{recipe}-{snr:g}dB-{seed}.toml"
    found.array.save(path)
    return {
        "file": path.name,
        "expected_error": found.merit,
        "median_drawn": float(found.drawn.median()),
        "best_drawn": float(found.drawn.min()),
    }
