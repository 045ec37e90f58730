"""Depth for every point, beside what a user would pick instead.

    pip install opencv-python-headless
    python benchmarks/depth.py [--calibration camera.nc] [--figure docs/images/depth.webp]

Captures solid scenes with the twin of the thesis' camera at 20 and 30 dB, finds their depth and
judges it by the planted one. Every cell of the tables is written to
experiments/results/depth.json as soon as it is measured; cells already there are not measured
again, nor are other methods where only the row of squilla is missing. Times are processor seconds
of one thread after a warm-up, for they hold on a busy machine.

cube error: noise-free sub-images, aligned by what was found in the noisy frame, hidden channels
filled as every reconstructor fills them, against the same picture captured as a plane facing the
camera and aligned at its known distance; relative RMS.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy import ndimage

import squilla
from squilla.calibration import depth as dense
from squilla.calibration import surfaces
from squilla.calibration.alignment import align, measure, place
from squilla.calibration.calibration import Calibration
from squilla.calibration.disparity import plane_map
from squilla.calibration.rehearsal import Rehearsal
from squilla.calibration.views import SubImages, sub_images, windows
from squilla.camera.scenes import load_scene
from squilla.camera.solid import solid_scene
from squilla.camera.twin import Camera
from squilla.files.cube import labelled
from squilla.reconstruction.linear import complete
from squilla.reconstruction.models import load_model
from squilla.spectra import CHART_LIGHT, lights, reflectances

RESULTS = Path(__file__).parent.parent / "experiments" / "results" / "depth.json"
NEAREST = 80.0
"""Shortest distance that every method looks for, mm."""


# --- scenes -------------------------------------------------------------------------------------


def layers_scene(wavelength: np.ndarray, seed: int):
    """Three tilted, textured planes at about 140, 190 and 300 mm that hide each other."""
    random = np.random.default_rng(seed)
    table = reflectances().on(wavelength).astype(np.float32)
    lamp = lights().on(wavelength)[lights().name.index(CHART_LIGHT)].astype(np.float32)
    y, x = (np.mgrid[:250, :250] + 0.5) / 250 - 0.5

    def surface():
        noise = sum(
            ndimage.gaussian_filter(random.standard_normal((250, 250)), 0.8 * scale) * scale
            for scale in (1, 2, 4, 8)
        )
        mix = np.clip(0.5 + 0.3 * noise / noise.std(), 0, 1)[..., None].astype(np.float32)
        one, other = table[random.choice(len(table), 2, replace=False)]
        return one + (other - one) * mix

    scene, depth = surface(), 300 + 30 * x + 10 * y
    disc = np.hypot(y + 0.05, x + 0.12) < 0.25
    scene[disc], depth[disc] = surface()[disc], (190 + 25 * y - 20 * x)[disc]
    card = (np.abs(y - 0.15) < 0.17) & (np.abs(x - 0.15) < 0.2)
    scene[card], depth[card] = surface()[card], (140 - 25 * x + 15 * y)[card]
    return labelled(scene * lamp, wavelength, attributes={"light": CHART_LIGHT}), depth


class Take:
    """A scene with its planted depth, as the camera sees it with and without noise."""

    def __init__(self, camera: Camera, calibration: Calibration, scene, depth, seed: int):
        self.camera, self.calibration, self.seed = camera, calibration, seed
        self.lattice, self.pixels = calibration.lattice, calibration.pixels
        self.scene, self.depth = scene, depth
        self.distance = float(np.median(depth))
        self.truth = self.lattice.disparity(1.0) / depth
        self.rate = camera.rate(scene, depth=depth)
        self.plane_rate = camera.rate(scene, distance=self.distance)
        reach = float(np.abs(self.lattice.baseline).max())
        self.margin = int(np.ceil(self.lattice.disparity(NEAREST) * reach)) + 8

    def raws(self, snr: float):
        """Return the noisy frame of the scene and of its plane."""
        exposure = self.camera.sensor.exposure_for(self.camera.fields(self.rate), snr)
        return [
            self.camera.expose(rate, exposure, torch.Generator().manual_seed(2 * self.seed + k))
            for k, rate in enumerate((self.rate, self.plane_rate))
        ]

    def views(self, raw) -> tuple[SubImages, np.ndarray]:
        """Return the sub-images of a frame and the variance of their noise."""
        views = sub_images(raw, self.lattice, self.pixels, self.margin)
        inner = slice(self.margin, -self.margin)
        signal = views.image[:, inner, inner].mean((1, 2)).clamp_min(0).numpy()
        gain, read = self.pixels.gain, self.pixels.read_noise
        return views, signal / gain + (read / gain) ** 2 + 1 / 12

    def _clean(self, rate: np.ndarray) -> SubImages:
        origin, image = windows(rate / self.camera.design.sensor.gain, self.lattice, self.margin)
        offset = self.lattice.centre - origin - (np.array(self.lattice.field) - 1) / 2 - self.margin
        image = torch.from_numpy(image.astype(np.float32))
        return SubImages(image, torch.zeros(image.shape, dtype=torch.bool), offset, self.margin, 0)

    def cube_error(self, disparity: np.ndarray, seen: np.ndarray | None) -> float:
        y, _ = align(self._clean(self.rate), self.lattice, disparity)
        if seen is not None:
            angle = torch.from_numpy(self.lattice.field_angle()).float()
            snr = torch.full(angle.shape, 20.0)
            filled = complete(y, torch.from_numpy(seen), self.calibration, angle, snr)
            y = torch.where(filled.isfinite(), filled, y)
        known = self.lattice.disparity(self.distance)
        right, _ = align(self._clean(self.plane_rate), self.lattice, known)
        inner = slice(6, -6)
        error = (y - right)[inner, inner].norm() / right[inner, inner].norm()
        return float(error)


# --- what a user would pick instead ---------------------------------------------------------------


def _steepness(views: SubImages) -> np.ndarray:
    """Return gradient magnitudes over their local mean, (M, H, W) float32."""
    maps = [ndimage.gaussian_gradient_magnitude(image, 1.0) for image in views.image.numpy()]
    return np.stack([each / (ndimage.gaussian_filter(each, 6.0) + 1e-6) for each in maps])


def _aligned_at(take: Take, pictures: np.ndarray, views: SubImages, disparity: float):
    moved = SubImages(torch.from_numpy(pictures), views.bad, views.offset, views.margin, 0)
    return align(moved, take.lattice, disparity)[0].permute(2, 0, 1).numpy()


def one_plane(take: Take, views: SubImages, noise: np.ndarray) -> np.ndarray:
    """What `measure` does without depth."""
    plane, _, _ = place(views, take.lattice, take.lattice.disparity(NEAREST), noise=noise)
    return plane_map(plane, take.lattice).astype(np.float32)


def patch_matching(take: Take, views: SubImages, noise: np.ndarray, side: int = 11) -> np.ndarray:
    """Each unit against the reference by correlation of patches, in two dimensions."""
    start = float(np.median(one_plane(take, views, noise)))
    maps = _aligned_at(take, _steepness(views), views, start)
    lattice = take.lattice

    def mean(picture):
        return cv2.boxFilter(picture, -1, (side, side))

    reference = maps[lattice.reference]
    own = mean(reference * reference) - mean(reference) ** 2
    found = []
    for unit, view in enumerate(maps):
        baseline = lattice.baseline[unit]
        length = float(np.hypot(*baseline))
        if length < 0.9:
            continue
        reach = [int(np.ceil(1.8 * abs(part))) + 1 for part in baseline]
        size = [2 * each + 1 for each in reach]
        score = np.empty((*size, *lattice.field), np.float32)
        for i in range(size[0]):
            for j in range(size[1]):
                moved = np.roll(view, (reach[0] - i, reach[1] - j), (0, 1))
                other = mean(moved * moved) - mean(moved) ** 2
                shared = mean(reference * moved) - mean(reference) * mean(moved)
                score[i, j] = shared / np.sqrt(np.maximum(own * other, 1e-9))
        best = score.reshape(-1, *lattice.field).argmax(0)
        place = np.stack(np.unravel_index(best, size)).astype(float)
        row, column = np.indices(lattice.field)
        for axis in range(2):
            whole = [place[0].astype(int), place[1].astype(int)]
            whole[axis] = np.clip(whole[axis], 1, size[axis] - 2)
            near = []
            for step in (-1, 0, 1):
                at = list(whole)
                at[axis] = at[axis] + step
                near.append(score[at[0], at[1], row, column])
            bend = np.minimum(near[0] - 2 * near[1] + near[2], -1e-6)
            place[axis] += np.clip((near[0] - near[2]) / (2 * bend), -0.5, 0.5)
        shift = place - np.array(reach)[:, None, None]
        found.append(np.tensordot(baseline / length**2, shift, 1))
    return (start + np.median(found, 0)).astype(np.float32)


def optical_flow(take: Take, views: SubImages, noise: np.ndarray) -> np.ndarray:
    """Each unit against the reference by OpenCV's DIS flow, medium preset, on gradients."""
    start = float(np.median(one_plane(take, views, noise)))
    maps = np.clip(_aligned_at(take, _steepness(views), views, start) * 70, 0, 255).astype(np.uint8)
    engine = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    found = []
    for unit, baseline in enumerate(take.lattice.baseline):
        if np.hypot(*baseline) > 0.9:
            flow = engine.calc(maps[take.lattice.reference], maps[unit], None)[..., ::-1]
            found.append(flow @ baseline / (baseline**2).sum())
    return (start + np.median(found, 0)).astype(np.float32)


def stereo_pairs(take: Take, views: SubImages, noise: np.ndarray) -> np.ndarray:
    """OpenCV's StereoSGBM on gradients: the ten units in the reference's row and column."""
    lattice = take.lattice
    maps = np.clip(_aligned_at(take, _steepness(views), views, 0.0) * 70, 0, 255).astype(np.uint8)
    reach = float(np.abs(lattice.baseline).max())
    levels = 16 * int(np.ceil(lattice.disparity(NEAREST) * reach / 16))
    engine = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=levels, blockSize=5, P1=200, P2=800, disp12MaxDiff=-1,
        uniquenessRatio=5, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    found = []
    for unit, (down, across) in enumerate(lattice.baseline):
        if min(abs(down), abs(across)) > 0.1 or max(abs(down), abs(across)) < 0.9:
            continue
        pair = [maps[lattice.reference], maps[unit]]
        along = across
        if abs(down) > 0.5:
            pair, along = [each.T for each in pair], down
        if along > 0:  # it looks for points that lie further left in the second picture
            pair = [each[:, ::-1] for each in pair]
        pair = [cv2.copyMakeBorder(each, 0, 0, levels, 0, cv2.BORDER_REFLECT) for each in pair]
        shift = engine.compute(*map(np.ascontiguousarray, pair))[:, levels:].astype(float) / 16
        shift[shift < 0] = np.nan
        shift = shift[:, ::-1] if along > 0 else shift
        found.append((shift.T if abs(down) > 0.5 else shift) / abs(along))
    middle = np.nanmedian(found, 0)
    empty = np.isnan(middle)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return middle[tuple(nearest)].astype(np.float32)


def every_point(take: Take, views: SubImages, noise: np.ndarray):
    """What `measure(..., depth=True)` does: the plane first, then every point."""
    usual = one_plane(take, views, noise)
    return dense.find_depth(views, take.lattice, noise, take.lattice.disparity(NEAREST), usual)


METHODS: dict[str, Callable[[Take, SubImages, np.ndarray], np.ndarray]] = {
    "one plane": one_plane,
    "2-D patch matching": patch_matching,
    "DIS optical flow": optical_flow,
    "StereoSGBM, ten pairs": stereo_pairs,
}


# --- tables ---------------------------------------------------------------------------------------


def judged(take: Take, disparity: np.ndarray, trusted: np.ndarray | None = None) -> dict:
    error = np.abs(disparity - take.truth)
    told = {
        "median": float(np.median(error)),
        "within_0.1_percent": 100 * float(np.mean(error < 0.1)),
        "within_0.5_percent": 100 * float(np.mean(error < 0.5)),
    }
    if trusted is not None:
        told["confident_percent"] = 100 * float(trusted.mean())
        told |= {f"confident_{key}": value for key, value in {
            "median": float(np.median(error[trusted])),
            "within_0.1_percent": 100 * float(np.mean(error[trusted] < 0.1)),
            "within_0.5_percent": 100 * float(np.mean(error[trusted] < 0.5)),
        }.items()}  # fmt: skip
    return told


def compared(take: Take, snr: float, known: dict) -> dict:
    """Return what every method makes of a scene; what is known of others is not measured again."""
    views, noise = take.views(take.raws(snr)[0])
    baseline, rows = take.lattice.baseline, dict(known)
    for name, method in METHODS.items():
        if name in known:
            continue
        if method is not patch_matching:  # nothing of it is compiled
            method(take, views, noise)
        start = time.process_time()
        found = method(take, views, noise)
        seconds = time.process_time() - start
        seen = None if method is one_plane else surfaces.unhidden(found, baseline)
        error = take.cube_error(found, seen)
        rows[name] = judged(take, found) | {"cube_error": error, "seconds": seconds}
    every_point(take, views, noise)
    start = time.process_time()
    found, deviation, seen = every_point(take, views, noise)
    seconds = time.process_time() - start
    rows["squilla"] = judged(take, found, deviation <= dense._SURE) | {
        "cube_error": take.cube_error(found, seen),
        "seconds": seconds,
        "expected_over_found": float(
            np.median(deviation[deviation <= dense._SURE])
            / (np.median(np.abs(found - take.truth)[deviation <= dense._SURE]) / 0.6745)
        ),
        "seen_by_fewer_than_half": int((seen.mean(-1) < 0.5).sum()),
    }
    seen = surfaces.unhidden(take.truth.astype(np.float32), baseline)
    rows["the truth"] = judged(take, take.truth) | {"cube_error": take.cube_error(take.truth, seen)}
    return rows


def where(take: Take, snr: float) -> dict:
    """Return which parts of a scene are found wrongly, percent of its points."""
    views, noise = take.views(take.raws(snr)[0])
    error = np.abs(every_point(take, views, noise)[0] - take.truth)
    step = ndimage.maximum_filter(take.truth, 3) - ndimage.minimum_filter(take.truth, 3) > 0.12
    light = take.scene.values.mean(-1) / take.scene.values.mean()
    texture = ndimage.gaussian_filter(ndimage.gaussian_gradient_magnitude(light, 1.2), 2.0)
    away = ndimage.distance_transform_edt(~step)
    parts = {
        "up to 2 px from a jump": away <= 2,
        "3 to 6 px from a jump": (away > 2) & (away <= 6),
        "textured": (away > 6) & (texture > 0.012),
        "plain, bright": (away > 6) & (texture <= 0.012) & (light > 0.5),
        "plain, dark": (away > 6) & (texture <= 0.012) & (light <= 0.5),
    }
    return {
        name: {"share": 100 * float(part.mean())}
        | {f"over_{limit}": 100 * float(np.mean(part & (error > limit))) for limit in (0.1, 0.5)}
        for name, part in parts.items()
    }


def spectra(take: Take, snr: float) -> dict:
    """Return the mean squared error of whole cubes over the mean square of the truth."""
    raw, plane = take.raws(snr)
    truth = take.camera.truth(take.scene, depth=take.depth).cube
    measurements = {
        "one plane": measure(raw, take.calibration),
        "squilla": measure(raw, take.calibration, nearest=NEAREST, depth=True),
        "perfectly aligned": measure(plane, take.calibration, distance=take.distance),
    }
    rows: dict = {name: {} for name in measurements}
    for model in ("ridge", "sparse"):
        reconstruct = load_model(model, take.calibration).reconstruct
        for name, measurement in measurements.items():
            error = np.square(reconstruct(measurement).values - truth.values)
            rows[name][model] = float(np.nanmean(error) / np.mean(np.square(truth.values)))
    return rows


def flat(camera: Camera, calibration: Calibration, name: str, distance: float = 300.0) -> dict:
    """Return what depth costs on a scene that has none."""
    scene = load_scene(name, camera.design.wavelength, camera.design.field.size)
    take = Take(camera, calibration, scene, np.full(scene.shape[:2], distance), 5)
    views, noise = take.views(take.raws(20.0)[0])
    once = one_plane(take, views, noise)
    found, deviation, seen = every_point(take, views, noise)
    return {
        "one plane": judged(take, once) | {"cube_error": take.cube_error(once, None)},
        "squilla": judged(take, found, deviation <= dense._SURE)
        | {"cube_error": take.cube_error(found, seen)},
    }


def ranged(camera: Camera, calibration: Calibration, distance: float) -> dict:
    """Return the error of distances beside what the geometry allows, 30 dB."""
    scene, depth = solid_scene(
        camera.design.wavelength, distance=distance, relief=0.2 * distance, seed=11
    )
    take = Take(camera, calibration, scene, depth, 11)
    views, noise = take.views(take.raws(30.0)[0])
    disparity, deviation, _ = every_point(take, views, noise)
    found = dense.Depth.of(disparity, deviation, take.lattice)
    sure = found.confident.numpy()
    error = np.abs(found.distance.numpy() - depth)[sure]
    return {
        "confident_percent": 100 * float(sure.mean()),
        "median_error_mm": float(np.median(error)),
        "expected_median_mm": 0.6745 * float(np.median(found.error.numpy()[sure])),
        "mm_per_0.01_px": 0.01 * distance**2 / calibration.lattice.distance(1.0),
    }


def figure(take: Take, path: Path) -> None:
    """Draw sub-images, one plane, every point its own, and the depth."""
    from squilla.evaluation.style import WIDTH, draw_colour_bar, draw_picture, sheet, styled

    raw = take.raws(30.0)[0]
    views, _ = take.views(raw)
    one, every = measure(raw, take.calibration), measure(raw, take.calibration, depth=True)
    corners = [0, 5, 30]

    def false_colour(y):
        picture = y[..., corners]
        picture = picture / np.percentile(picture, 99.5, axis=(0, 1))
        return np.clip(picture, 0, 1) ** (1 / 1.6)

    @styled
    def draw():
        sheets = sheet(2, 4, 1.0, WIDTH, colour_bar=True)
        axes = sheets.axes
        inner = slice(take.margin, -take.margin)
        for spot, unit in enumerate((0, 5)):
            picture = views.image[unit, inner, inner].numpy()
            draw_picture(axes[4 * spot], picture, f"sub-image {unit}", vmin=0)
        part = (slice(62, 152), slice(132, 222))
        for spot, (name, each) in enumerate({"one plane": one, "every point": every}.items()):
            colours = false_colour(each.y.numpy())
            draw_picture(axes[1 + spot], colours, name)
            draw_picture(axes[5 + spot], colours[part], f"{name}, enlarged")
        limits = {"vmin": take.depth.min() - 2, "vmax": take.depth.max() + 2, "cmap": "viridis_r"}
        draw_picture(axes[3], take.depth, "true distance", **limits)
        assert every.depth is not None
        found = every.depth.distance.numpy()
        pale = np.where(every.depth.confident.numpy(), 1.0, 0.35)
        draw_picture(axes[7], found, "found (pale: not sure)", alpha=pale, **limits)
        draw_colour_bar(sheets, axes[3].images[0], "distance (mm)")
        return sheets

    draw().savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.04)


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--calibration", type=Path)
    options.add_argument("--figure", type=Path)
    options.add_argument("--only", default="", help="cells whose name begins so")
    given = options.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera = Camera("thesis")
    wavelength = camera.design.wavelength
    if given.calibration:
        calibration = squilla.load_calibration(given.calibration)
    else:
        calibration = Rehearsal(camera, step=5.0, bandwidth=5.0).calibrate()
    scenes = {f"doll {seed}": (solid_scene, {"seed": seed}) for seed in (11, 12)}
    scenes |= {f"layers {seed}": (layers_scene, {"seed": seed}) for seed in (11, 12)}
    cells = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    cells["machine"] = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"

    def missing(name: str) -> bool:
        rows = cells.get(name, {})
        one = name.startswith("doll at") or name.endswith("where")
        whole = bool(rows) and (one or "squilla" in rows)
        return not whole and name.startswith(given.only)

    def cell(name: str, compute: Callable[[], dict]) -> None:
        if missing(name):
            found = compute()
            cells.update(json.loads(RESULTS.read_text()) if RESULTS.exists() else {})
            cells[name] = found
            RESULTS.write_text(json.dumps(cells, indent=1) + "\n")
            print(name, json.dumps(cells[name]), flush=True)

    for name, (build, how) in scenes.items():
        wanted = [f"{name}, {part}" for part in ("20 dB", "30 dB", "where", "spectra")]
        if not any(map(missing, wanted)) and not given.figure:
            continue
        take = Take(camera, calibration, *build(wavelength, **how), how["seed"])
        for snr in (20, 30):
            known = cells.get(f"{name}, {snr} dB", {})
            cell(f"{name}, {snr} dB", lambda t=take, s=snr, k=known: compared(t, s, k))
        cell(f"{name}, where", lambda take=take: where(take, 20.0))
        cell(f"{name}, spectra", lambda take=take: spectra(take, 20.0))
        if given.figure:
            figure(take, given.figure)
            return
    for name in ("chart", "corn-kernel", "indian-pines"):
        cell(f"flat {name}", lambda name=name: flat(camera, calibration, name))
    for distance in (100.0, 200.0, 400.0):
        cell(f"doll at {distance:g} mm", lambda d=distance: ranged(camera, calibration, d))
    table(cells)


def table(cells: dict) -> None:
    """Print the means over the scenes of a kind."""
    for kind in ("doll", "layers"):
        for snr in (20, 30):
            some = [each for name, each in cells.items()
                    if name.startswith(f"{kind} ") and name.endswith(f", {snr} dB")]  # fmt: skip
            if not some:
                continue
            print(f"\n{kind}, {snr} dB, {len(some)} scenes")
            for method in some[0]:
                keys = list(some[0][method])
                means = {key: np.mean([each[method][key] for each in some]) for key in keys}
                print(f"{method:<26}", "  ".join(f"{k} {v:.3g}" for k, v in means.items()))
    for name, each in cells.items():
        if name.endswith(("spectra", "where")) or name.startswith(("flat", "doll at")):
            print(f"\n{name}")
            for method, row in each.items():
                row = row if isinstance(row, dict) else {"": row}
                print(f"{method:<26}", "  ".join(f"{k} {v:.4g}" for k, v in row.items()))


if __name__ == "__main__":
    main()
