"""Alignment with the whole twin: five hand-held shots, tilted planes, an array that has moved.

    python experiments/alignment.py

Full frames of the thesis' camera, 3000 x 4000, with its blur, vignetting, field angles and noise;
lenses 3 um beside their places. The lattice is learnt from five shots of a poster at distances and
tilts that the calibration is not told. Then: what planes are found in front of that camera, whether
the error that every capture states of itself is right, and whether a shift of the array is noticed.
Writes experiments/results/alignment_twin.json and docs/images/alignment.webp; about six minutes.
"""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import squilla
from squilla.calibration.alignment import align
from squilla.calibration.disparity import plane_map
from squilla.calibration.rehearsal import Rehearsal, poster
from squilla.calibration.views import sub_images
from squilla.camera.design import CameraDesign
from squilla.camera.scenes import load_scene

HERE = Path(__file__).parent
SHOTS = ((130.0, 6, -4), (180.0, -9, 3), (260.0, 3, 10), (400.0, -5, -7), (700.0, 8, 2))
"""Distance, mm, and tilts, degrees, of the shots."""


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def design(position_seed: int = 0, **array) -> CameraDesign:
    tree = CameraDesign.load("thesis").model_dump()
    tree["array"] |= {"position_error": 3.0, "rotation": 0.8, "seed": position_seed} | array
    return CameraDesign.model_validate(tree)


def tilted(camera: squilla.Camera, size: int, distance: float, down: float, right: float):
    """Return depth, mm, of every scene sample of a plane, and its disparity in the field."""
    far = camera.design.array.pitch / 1000 * camera.design.focal
    place = (np.arange(size) - (size - 1) / 2) / camera.design.focal
    slope = np.tan(np.radians([down, right]))
    disparity = far / distance * (1 - slope[0] * place[:, None] - slope[1] * place[None, :])
    edge = (size - camera.design.field.size) // 2
    inner = slice(edge, edge + camera.design.field.size)
    return far / disparity, disparity[inner, inner]


def displacement(centre, baseline, bend, disparity):
    """Return where units see the field, (M, 2, H, W), a shift of all together taken away."""
    from squilla.calibration.resample import monomials

    field = disparity * baseline[..., None, None] + centre[..., None, None]
    if bend is not None:
        field = field + np.tensordot(bend, monomials(*disparity.shape)[1:], 1)
    return field - field.mean(0)


def knocks(centre: np.ndarray) -> dict[str, np.ndarray]:
    """Return ways an array may have moved, RMS about 0.3 px along each axis, each (M, 2)."""
    place = centre - centre.mean(0)
    place = 0.3 * place / rms(place)
    one = np.zeros_like(centre)
    one[5] = 0.7
    return {
        "as calibrated": np.zeros_like(centre),
        "every unit its own way": np.random.default_rng(4).normal(0, 0.3, centre.shape),
        "turned": place @ [[0, -1], [1, 0]],
        "one unit by 1 px": one,
        "shifted as a whole": np.full_like(centre, 0.3),
        "stretched": place,
    }


def main() -> None:
    camera = squilla.Camera(design())
    wavelength = camera.design.wavelength
    rehearsal = Rehearsal(camera, step=8.0, bandwidth=8.0, frames=4)

    def capture(scene, distance, down, right, snr, seed):
        depth, disparity = tilted(camera, len(scene), distance, down, right)
        generator = torch.Generator().manual_seed(seed)
        return camera.capture(scene, depth=depth, snr=snr, generator=generator), disparity

    print_out = poster(350, wavelength, seed=1)
    shots = [capture(print_out, *shot, 35, n)[0] for n, shot in enumerate(SHOTS)]
    calibration = rehearsal.calibrate(target=None, target_distance=None, shots=shots)
    lattice = calibration.lattice
    assert lattice is not None
    true = camera.design.centres
    true_baseline = (true - true[lattice.reference]) / camera.design.pitch
    found = lattice.centre - lattice.centre.mean(0)
    apart = true - true.mean(0)
    scale = float(np.sum(found * apart) / np.sum(found * found))
    results: dict = {
        "centres_px": rms(found - apart),
        "centres_px_but_for_scale": rms(scale * found - apart),
        "baselines_px_at_100_mm": rms(lattice.baseline - true_baseline) * lattice.disparity(100),
        "scale_error": scale - 1,
        "shots_mm_true_and_found": list(
            zip([s[0] for s in SHOTS], calibration.provenance["shot_distances"], strict=True)
        ),
        "captures": [],
    }
    print(json.dumps(results, indent=1))
    scenes = {"poster": poster(350, wavelength, seed=9)}
    scenes |= {n: load_scene(n, wavelength, 250) for n in ("chart", "corn-kernel", "indian-pines")}
    for name, scene in scenes.items():
        for distance, down, right in ((80, 0, 0), (150, 20, 0), (300, -14, 14), (1000, 0, 20)):
            for snr in (20.0, 30.0):
                raw, disparity = capture(scene, distance, down, right, snr, 7)
                with warnings.catch_warnings(record=True) as said:
                    warnings.simplefilter("always")
                    measurement = squilla.measure(raw, calibration)
                facts = measurement.provenance
                truth = displacement(true, true_baseline, None, disparity)
                error = displacement(
                    lattice.centre, lattice.baseline, lattice.bend, measurement.disparity.numpy()
                )
                views = sub_images(raw, lattice, calibration.pixels, 46)
                exact = replace(
                    lattice, baseline=true_baseline, bend=None, centre=true - true.mean(0)
                    + lattice.centre.mean(0),
                )  # fmt: skip
                moved = replace(views, offset=views.offset + exact.centre - lattice.centre)
                best = align(moved, exact, disparity)[0] / raw.exposure
                results["captures"].append(
                    {
                        "scene": name, "distance": distance, "tilt": [down, right], "snr": snr,
                        "rms_px": rms(error - truth), "stated_px": facts["misalignment"],
                        "colour_error": float((measurement.y - best).norm() / best.norm()),
                        "stated_colour_error": facts["colour_error"],
                        "score": facts["alignment_score"],
                        "warned": [str(w.message) for w in said],
                    }
                )  # fmt: skip
                print(json.dumps(results["captures"][-1]))
                if (name, distance, snr) == ("chart", 150, 30.0):
                    picture(calibration, measurement, views)
    results["knocked"] = {}
    for name, snr in (("poster", 30.0), ("poster", 20.0), ("chart", 30.0), ("corn-kernel", 30.0)):
        raw, disparity = capture(scenes[name], 250, 10, -5, snr, 8)
        for kind, beside in knocks(lattice.centre).items():
            # The frame is the same: it is the calibration that believes the units elsewhere.
            knocked = replace(lattice, centre=lattice.centre - beside)
            stale = replace(calibration, lattice=knocked)
            for refine in (False, None):
                with warnings.catch_warnings(record=True) as said:
                    warnings.simplefilter("always")
                    facts = squilla.measure(raw, stale, refine=refine).provenance
                results["knocked"][f"{name} {snr:g} dB, {kind}, refine {refine}"] = {
                    **{k: facts[k] for k in ("misalignment", "colour_error", "lattice_moved")},
                    "distance": facts["distance"],
                    "warned": [str(w.message) for w in said],
                }
    print(json.dumps(results["knocked"], indent=1))
    path = HERE / "results" / "alignment_twin.json"
    path.write_text(json.dumps(results, indent=1) + "\n")


def picture(calibration, measurement, views) -> None:
    """Draw raw sub-images, colours before and after alignment, edges enlarged, and the distance."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lattice = calibration.lattice
    before = align(views, lattice, 0.0)[0].numpy()
    middle = plane_map(np.array([float(measurement.disparity.mean()), 0, 0]), lattice)
    facing = align(views, lattice, middle)[0].numpy()
    after = measurement.y.numpy() * facing.mean() / measurement.y.numpy().mean()
    units, corner = [0, 20, 35], (slice(168, 238), slice(10, 80))

    def colours(y):
        y = y[..., units]
        return np.clip(y / np.percentile(y, 99, axis=(0, 1)), 0, 1) ** 0.6

    few = before[::3, ::3]
    few = np.clip(few / np.percentile(few, 99.5, (0, 1)), 0, 1) ** 0.6
    few = np.pad(few, ((0, 4), (0, 4), (0, 0)), constant_values=1)
    tiles = few.transpose(2, 0, 1).reshape(*lattice.shape, *few.shape[:2])
    raw = tiles.transpose(0, 2, 1, 3).reshape(lattice.shape[0] * few.shape[0], -1)
    wrong = 100 * np.linalg.norm(facing - after, axis=-1) / np.sqrt(np.mean(after**2) * 36)
    distance = lattice.distance(1.0) / measurement.disparity.numpy()
    panels = (
        ("36 raw sub-images", raw, {"cmap": "gray"}),
        ("before: units 0, 20, 35 as R, G, B", colours(before), {}),
        ("after", colours(after), {}),
        ("distance found, mm", distance, {"cmap": "viridis"}),
        ("edges before", colours(before)[corner], {}),
        ("edges, one shift for each unit", colours(facing)[corner], {}),
        ("edges after, tilt and all", colours(after)[corner], {}),
        ("colour error of one shift, %", wrong, {"cmap": "magma", "vmin": 0, "vmax": 20}),
    )
    figure, axes = pyplot.subplots(2, 4, figsize=(13, 6.6), layout="constrained")
    for axis, (title, image, options) in zip(axes.ravel(), panels, strict=True):
        drawn = axis.imshow(image, interpolation="nearest", **options)
        axis.set_title(title, fontsize=11)
        axis.set_axis_off()
        if "viridis" in options.values() or "magma" in options.values():
            figure.colorbar(drawn, ax=axis, shrink=0.85)
    path = HERE.parent / "docs" / "images" / "alignment.webp"
    figure.savefig(path, dpi=85, pil_kwargs={"quality": 80})
    pyplot.close(figure)


if __name__ == "__main__":
    main()
