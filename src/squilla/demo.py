"""The main job, end to end: four scenes through the camera of the thesis and back.

The twin takes calibration frames and one frame of each scene; everything after that knows only
those frames. The truth comes back at the end, to judge.
"""

import json
import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from xarray import DataArray

from squilla import __version__
from squilla.calibration.alignment import Measurement, align, measure
from squilla.calibration.calibrate import calibrate
from squilla.calibration.calibration import Calibration
from squilla.calibration.rehearsal import Rehearsal
from squilla.calibration.store import load_calibration
from squilla.calibration.views import sub_images
from squilla.camera.scenes import SCENES, chart_layout, load_scene
from squilla.camera.solid import solid_scene
from squilla.camera.twin import Camera, Truth
from squilla.errors import InputError
from squilla.evaluation.report import Trial, results_section, scene_section, write_report
from squilla.files.cube import save
from squilla.files.disk import make_folder, replacing
from squilla.files.raw import Raw, read_raw, write_raw
from squilla.reconstruction.models import load_model, model_class
from squilla.spectra import lights

MODELS = ("ridge", "sparse", "compound")

_TEXT = {
    "chart": "The 24 patches of a ColorChecker. The thesis averages its errors over the first 18.",
    "indian-pines": "Fields in Indiana seen by AVIRIS, taken as a flat picture.",
    "corn-kernel": "A corn kernel from a laboratory hyperspectral camera, enlarged eight times.",
    "doll": "A doll before a curtain, 40 mm deep: every point is aligned at its own distance.",
}

T = TypeVar("T")


def demo(
    folder: str | Path,
    *,
    camera: str | Path = "thesis",
    scenes: Iterable[str] = (*SCENES, "doll"),
    models: Iterable[str] = MODELS,
    distance: float = 300.0,
    snr: float = 20.0,
    seed: int = 0,
) -> dict:
    """Capture, calibrate, align, reconstruct, judge, draw.

    Writes raw frames, ``calibration.nc``, the cubes as .nc and .hdr, ``metrics.json`` and
    ``report.html``.

    Parameters
    ----------
    folder : str or Path
        Where to write; made if it is not there.
    camera : str or Path
        A camera design.
    scenes, models : iterable of str
        Names of `squilla.camera.scenes.SCENES` or "doll"; names of models.
    distance : float
        Of the scenes, mm.
    snr : float
        dB, 20 log10.
    seed : int
        Of all noise.

    Returns
    -------
    dict
        What ``metrics.json`` holds: scene -> model -> metric -> number, and for each scene
        "alignment_rms_px".

    Raises
    ------
    InputError
        If there is no such camera, scene or model, or a scene cannot be captured so.
    """
    folder, scenes, models = Path(folder), list(scenes), list(models)
    # Said now, not after minutes of calibration.
    strangers = [name for name in scenes if name not in (*SCENES, "doll")]
    if strangers or not math.isfinite(snr) or not 0 < distance < math.inf:
        raise InputError(
            f"The scenes {', '.join(scenes)} at {distance:g} mm and {snr:g} dB cannot be shown; "
            f"there are {', '.join(SCENES)} and doll, at any positive distance and finite SNR."
        )
    if not scenes or not models:
        raise InputError("Name one scene and one model, or more.")
    for name in models:
        model_class(name)
    twin = Camera(camera)
    if twin.design.filters.layout != "array":
        raise InputError(
            f"The filters of {twin.design.name!r} are in a {twin.design.filters.layout} layout; "
            "the demo shows cameras with a lens array."
        )
    make_folder(folder)
    with _progress() as progress, ThreadPoolExecutor(1) as pool:
        warm = pool.submit(_warm_up, models)
        learnt = _calibrate(twin, seed, progress)
        learnt.save(folder / "calibration.nc")
        calibration = load_calibration(folder / "calibration.nc")
        trials, metrics = [], {}
        reconstructors = {name: load_model(name, calibration) for name in models}
        warm.result()
        wavelength, size = twin.design.wavelength, twin.design.field.size
        for number, name in enumerate(_counted(progress, "scenes", scenes)):
            if name == "doll":
                scene, relief = solid_scene(wavelength, size, distance=distance)
            else:
                scene, relief = load_scene(name, wavelength, size), None
            generator = torch.Generator().manual_seed(1000 * seed + number)
            raw = twin.capture(scene, distance=distance, depth=relief, snr=snr, generator=generator)
            path = folder / (f"raw-{name}.tiff" if number else "raw.tiff")
            write_raw(path, raw)
            raw = read_raw(path)
            measurement = measure(raw, calibration, depth=relief is not None)
            cubes, seconds = {}, {}
            for model, reconstructor in reconstructors.items():
                start = perf_counter()
                cubes[model] = reconstructor.reconstruct(measurement)
                seconds[model] = perf_counter() - start
                for suffix in (".nc", ".hdr"):
                    save(cubes[model], folder / f"{name}-{model}{suffix}")
            truth = twin.truth(scene, distance=distance, depth=relief)
            trial = _trial(name, truth, cubes, seconds, raw, calibration, measurement)
            trials.append(trial)
            metrics[name] = {
                model: {**trial.metrics[model], "seconds": seconds[model]} for model in cubes
            }
            metrics[name]["alignment_rms_px"] = alignment_error(calibration, measurement, truth)
        with replacing(folder / "metrics.json") as temporary:
            temporary.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        sections = [results_section(trials)]
        sections += [scene_section(trial) for trial in _counted(progress, "pictures", trials)]
        facts = {
            "camera": twin.serial,
            "distance": f"{distance:g} mm",
            "SNR": f"{snr:g} dB",
            "calibrated from": f"{learnt.provenance['sweep_steps']} narrow-band flats, white "
            "flats, darks and one poster",
            "software": f"squilla {__version__}, torch with {torch.get_num_threads()} threads",
        }
        write_report(
            folder / "report.html",
            sections,
            title="From one exposure to a spectrum in every pixel",
            text=f"Scenes seen once by the digital twin of the camera {twin.design.name!r} and "
            "reconstructed from its raw frames alone. The truth is used only to judge.",
            facts=facts,
        )
    return metrics


def alignment_error(calibration: Calibration, measurement: Measurement, truth: Truth) -> float:
    """Return the RMS error of where the sub-images were aligned, px; for judging only.

    Over all units, against the reference, and over all points of a scene with depth.
    """
    lattice = calibration.lattice
    assert lattice is not None
    reference = lattice.reference
    apart = truth.centres - truth.centres[reference]
    offset = lattice.centre - lattice.centre[reference] - apart
    found, right = (
        each.reshape(-1, 1, 1) for each in (measurement.disparity.numpy(), truth.disparity)
    )
    if np.ptp(found) == np.ptp(right) == 0:
        found, right = found[:1], right[:1]
    error = offset + found * lattice.baseline - right * apart / lattice.pitch
    return float(np.sqrt(np.mean(error**2)))


def _calibrate(twin: Camera, seed: int, progress: Progress) -> Calibration:
    """Rehearse the calibration, with a bar for its frames."""
    rehearsal = Rehearsal(twin, seed=seed, step=5.0, bandwidth=5.0)
    steps = 3 * rehearsal.frames + len(rehearsal.wavelengths) + 1  # darks of two exposures, flats
    task = progress.add_task("calibration frames", total=steps)

    def ticking(frames: Iterable[T]) -> Iterator[T]:
        for frame in frames:
            progress.advance(task)
            yield frame

    return calibrate(
        twin.design,
        dark=ticking(rehearsal.dark()),
        flat=ticking(rehearsal.flat()),
        sweep=ticking(rehearsal.sweep()),
        target=next(ticking([rehearsal.target()])),
        target_distance=rehearsal.distance,
    )


def _trial(
    name: str,
    truth: Truth,
    cubes: dict[str, DataArray],
    seconds: dict[str, float],
    raw: Raw,
    calibration: Calibration,
    measurement: Measurement,
) -> Trial:
    """Gather what the report shows of one scene."""
    lattice = calibration.lattice
    light = truth.cube.attrs.get("light")
    return Trial(
        name=name,
        truth=truth.cube,
        estimates=cubes,
        seconds=seconds,
        text=_TEXT.get(name, ""),
        light=None if light is None else lights().one(light, calibration.wavelength),
        raw=raw,
        lattice=lattice,
        before=_unaligned(raw, calibration),
        after=measurement.y.permute(2, 0, 1).numpy(),
        disparity=measurement.disparity.numpy(),
        labels=chart_layout(*lattice.field) if name == "chart" and lattice is not None else None,
        depth=measurement.depth,
    )  # fmt: skip


def _unaligned(raw: Raw, calibration: Calibration) -> np.ndarray:
    """Return the sub-images as they lie on the lattice, parallax and all, (M, H, W)."""
    lattice, pixels = calibration.lattice, calibration.pixels
    assert lattice is not None
    assert pixels is not None
    y, _ = align(sub_images(raw, lattice, pixels, 8), lattice, 0.0)
    return y.permute(2, 0, 1).numpy()


def _warm_up(models: Iterable[str]) -> None:
    """Let the models' compilers finish, on a random camera, before anything is timed."""
    response = np.random.default_rng(0).random((12, 51))
    camera = Calibration.from_sensitivity(response, np.linspace(500, 750, 51))
    for name in models:
        model_class(name)(camera)(torch.ones(2, 12))


def _counted(progress: Progress, name: str, items: list[T]) -> Iterator[T]:
    task = progress.add_task(name, total=len(items))
    for item in items:
        yield item
        progress.advance(task)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description:<20}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    )
