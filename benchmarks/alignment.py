"""Align planes at many distances and tilts, beside what a user would pick instead.

    python benchmarks/alignment.py            # every cell; resumes where it was stopped
    python benchmarks/alignment.py --speed    # each stage's time alone
    python benchmarks/alignment.py --report   # print the tables again

Sub-images are rendered by the lattice model itself: seven scenes, planes at 80 to 1000 mm turned by
up to 20 degrees, through 36 random filter arrays in turn, with the filters' shift over the field,
blur of 0.8 px and photon and read noise. The methods know the calibration and the noise, never the
plane. Peers find one shift for each unit against the reference and are asked about planes that
face the camera only. Writes experiments/results/alignment.json.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numba
import numpy as np
import torch
from scipy import ndimage

from squilla.calibration.alignment import align, measure, place
from squilla.calibration.calibration import Calibration, Lattice, Pixels
from squilla.calibration.disparity import find_plane, plane_map
from squilla.calibration.edges import Edges, find_edges
from squilla.calibration.rehearsal import poster
from squilla.calibration.resample import monomials
from squilla.calibration.views import SubImages, evened, sub_images
from squilla.camera.design import CameraDesign
from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.files.raw import Raw
from squilla.spectra import lights
from squilla.threads import single_threaded_products

RESULTS = Path(__file__).parent.parent / "experiments" / "results" / "alignment.json"
WAVELENGTH = np.arange(500.0, 751.0)
SCENES = ("chart", "corn-kernel", "indian-pines", "poster", "cloth", "lines", "faint")
DISTANCES = (80.0, 150.0, 300.0, 1000.0)
COMPARED = (150.0, 1000.0)  # distances at which the peers are asked too
TILTS = ((0.0, 0.0), (20.0, 0.0), (-14.0, 14.0))  # degrees about the two axes
SNRS = (20.0, 30.0)
MARGIN = 46
ARRAYS = 36
READ_NOISE = 2.5
MOVED = (0.2, 0.03, 0.03)  # px per pitch, by which the plane lay elsewhere in the frame before


# --- what is photographed -------------------------------------------------------------------------


@cache
def camera(seed: int) -> Camera:
    """Return the thesis' camera with other random filters and lenses 3 um beside their places."""
    tree = CameraDesign.load("thesis").model_dump()
    tree["filters"] |= {"seed": seed}
    tree["array"] |= {"position_error": 3.0, "rotation": 1.0}
    return Camera(CameraDesign.model_validate(tree))


def lattice_of(design: CameraDesign) -> Lattice:
    reference, size = design.field.reference, design.field.size
    baseline = (design.centres - design.centres[reference]) / design.pitch
    return Lattice(
        (design.array.rows, design.array.columns), design.centres, baseline, reference,
        (size, size), design.focal, design.pitch, design.sensor.pixel, design.lens.focus_distance,
    )  # fmt: skip


@cache
def calibration_of(seed: int) -> Calibration:
    """Return what a perfect calibration of a camera would know: lattice, filters and angles."""
    lattice = lattice_of(camera(seed).design)
    angle = np.array([0.0, np.arctan(180 / lattice.focal)])
    return Calibration(WAVELENGTH, camera(seed).response(angle), angle, lattice)


@cache
def scene(name: str) -> np.ndarray:
    """Return a scene, (250, 250, 251) float32."""
    if name in ("chart", "corn-kernel", "indian-pines"):
        return load_scene(name, WAVELENGTH).values
    lamp = lights().on(WAVELENGTH)[0]
    lamp = (lamp / lamp.max()).astype(np.float32)
    random = np.random.default_rng(5)

    def bumps(size: float) -> np.ndarray:
        noise = ndimage.gaussian_filter(random.standard_normal((250, 250)), size)
        return noise / noise.std()

    if name == "poster":
        return poster(250, WAVELENGTH, seed=9).values * lamp
    if name == "faint":  # 3 % of contrast, nothing finer than 8 px
        return (0.5 * (1 + 0.03 * bumps(8))[..., None] * lamp).astype(np.float32)
    if name == "cloth":  # one colour, shaded folds
        down, across = np.gradient(6 * bumps(10))
        shade = np.clip((1 + 0.5 * across + 0.3 * down) / np.hypot(1, np.hypot(across, down)), 0, 9)
        red = 0.15 + 0.6 / (1 + np.exp(-(WAVELENGTH - 610) / 12))
        return (shade[..., None] / 1.2 * lamp * red).astype(np.float32)
    total = np.zeros((250, 250, len(WAVELENGTH)), np.float32)
    for line in (532, 611, 655):  # three lasers, each with a picture of its own
        picture = sum(size * bumps(size) for size in (1.2, 3, 8))
        picture = (picture - picture.min()) / np.ptp(picture)
        total += (picture[..., None] * np.exp(-((WAVELENGTH - line) ** 2) / 4.5)).astype(np.float32)
    return total


@cache
def factors(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a scene as ten pictures and their spectra."""
    pixels = scene(name).reshape(-1, len(WAVELENGTH))
    spectra = np.linalg.eigh(pixels.T @ pixels)[1][:, :-11:-1]
    return (pixels @ spectra).reshape(250, 250, 10), spectra


def plane(lattice: Lattice, distance: float, tilt: tuple[float, float]) -> np.ndarray:
    """Return the disparity of a tilted plane: middle, growth to the last row and column."""
    middle = lattice.disparity(distance)
    slope = np.tan(np.radians(tilt)) * (lattice.field[0] - 1) / 2 / lattice.focal
    return np.array([middle, *(-middle * slope)])


def render(name: str, seed: int, surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what the units see, (M, H + 2 margin, W + 2 margin), and their windows' offsets."""
    design = camera(seed).design
    lattice = lattice_of(design)
    pictures, spectra = factors(name)
    corner = np.arctan(180 / lattice.focal)
    response = camera(seed).response([0.0, corner]) @ spectra  # (2, M, 10)
    half = (lattice.field[0] - 1) / 2
    origin = np.floor(lattice.centre - half).astype(int) - MARGIN
    offset = lattice.centre - origin - half - MARGIN
    size = lattice.field[0] + 2 * MARGIN
    pixel = np.mgrid[:size, :size].astype(float)
    images = np.empty((len(offset), size, size), np.float32)
    blurred = [
        ndimage.gaussian_filter(each, 0.8, mode="reflect") for each in np.moveaxis(pictures, -1, 0)
    ]
    smooth = np.stack([ndimage.spline_filter(each, mode="reflect") for each in blurred], -1)
    for unit in range(len(offset)):
        seen = pixel - MARGIN - offset[unit][:, None, None]  # at infinity, on the reference's grid
        y, x = (seen - half) / half
        # Where seen = point + disparity(point) * baseline, for a disparity that is affine.
        disparity = surface[0] + surface[1] * y + surface[2] * x
        disparity /= 1 + surface[1:] @ lattice.baseline[unit] / half
        point = seen - disparity * lattice.baseline[unit][:, None, None]
        weight = np.arctan(np.hypot(*(seen - half)) / lattice.focal) ** 2 / corner**2
        total = 0
        for share, angle in ((1 - weight, 0), (weight, 1)):
            picture = smooth @ response[angle, unit]
            total = total + share * ndimage.map_coordinates(
                picture, point, mode="reflect", prefilter=False
            )
        images[unit] = np.maximum(total, 0)
    return images, offset


def exposed(images: np.ndarray, snr: float, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return photoelectrons at an SNR over all units, their noise's variance (M,), the exposure."""
    inner = images[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    power, mean, ratio = float((inner**2).mean()), float(inner.mean()), 10 ** (snr / 10)
    dark = READ_NOISE**2
    time = (ratio * mean + np.sqrt((ratio * mean) ** 2 + 4 * power * ratio * dark)) / (2 * power)
    random = np.random.default_rng(seed)
    electrons = random.poisson(images * time) + READ_NOISE * random.standard_normal(images.shape)
    return electrons.astype(np.float32), np.maximum(electrons.mean((1, 2)), 0) + dark, time


def bound(electrons, noise, offset, lattice: Lattice, surface: np.ndarray) -> float:
    """Return the Cramer-Rao bound of the RMS misplacement over units and field, px.

    By noise-free `electrons`: as if of the scene all were known but the brightness of each point,
    by which all units' views of it change together.
    """
    bad = torch.zeros(electrons.shape, dtype=torch.bool)
    views = SubImages(torch.from_numpy(electrons.astype(np.float32)), bad, offset, MARGIN, 0.0)
    y = align(views, lattice, plane_map(surface, lattice))[0].numpy() / np.sqrt(noise)
    down, across = np.gradient(y, axis=(0, 1))
    change = down * lattice.baseline[:, 0] + across * lattice.baseline[:, 1]
    known = (change**2).sum(-1) - (change * y).sum(-1) ** 2 / (y**2).sum(-1)
    terms = monomials(*lattice.field)[:3].reshape(3, -1)
    covariance = np.linalg.inv(known.ravel() * terms @ terms.T)
    apart = lattice.baseline - lattice.baseline.mean(0)  # a shift of all units together is none
    spread = np.trace(covariance @ (terms @ terms.T)) / terms.shape[1]
    return float(np.sqrt(np.mean(apart**2) * spread))


# --- who aligns -----------------------------------------------------------------------------------


def placed(images, noise, calibration, offset, start=None):
    """Return the plane of the scene, the units' offsets and how well both are known."""
    lattice = calibration.lattice
    bad = torch.zeros(images.shape, dtype=torch.bool)
    views = SubImages(torch.from_numpy(images), bad, offset, MARGIN, 0.0)
    views = evened(views, lattice, calibration)
    return place(views, lattice, lattice.disparity(60), noise=noise, start=start)


def squilla(images, noise, calibration, offset, start=None) -> tuple[np.ndarray, dict]:
    """Return the displacement of every unit over the field, (M, 2, H, W), and what it states."""
    lattice = calibration.lattice
    plane, moved, facts = placed(images, noise, calibration, offset, start)
    found = plane_map(plane, lattice) * lattice.baseline[..., None, None] + moved[..., None, None]
    stated = {
        "stated": facts["misalignment"],
        "textured": facts["alignment"] == "from the scene",
        "moved": bool(moved.any()),
    }
    return found, stated


def squilla_again(images, noise, calibration, offset) -> tuple[np.ndarray, dict]:
    """Do the same from a frame before, in which the plane lay elsewhere."""
    start = placed(images, noise, calibration, offset)[0] + MOVED
    begin = time.process_time()
    found, stated = squilla(images, noise, calibration, offset, start)
    return found, stated | {"cpu_seconds": time.process_time() - begin}


def pairwise(shift: Callable) -> Callable:
    """Return a method that finds each unit's own shift by `shift(reference, image)`."""

    def method(images, noise, calibration, offset) -> tuple[np.ndarray, dict]:
        lattice = calibration.lattice
        cut = images[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
        found = np.array([shift(cut[lattice.reference], image) for image in cut])
        return (found - offset + offset[lattice.reference])[..., None, None], {}

    return method


def slopes(image: np.ndarray) -> np.ndarray:
    """Return the gradient's magnitude, smoothed by 1 px."""
    return ndimage.gaussian_gradient_magnitude(image, 1.0)


def phase(reference, image):
    from skimage.registration import phase_cross_correlation

    return -phase_cross_correlation(reference, image, upsample_factor=20)[0]


def correlation(reference, image):
    """Normalised cross-correlation of the middle, its peak by a parabola."""
    from skimage.feature import match_template

    edge = 45
    surface = match_template(image, reference[edge:-edge, edge:-edge])
    peak = np.unravel_index(np.argmax(surface), surface.shape)
    shift = np.array(peak, float) - edge
    for axis in (0, 1):
        if 0 < peak[axis] < surface.shape[axis] - 1:
            line = np.take(surface, peak[1 - axis], 1 - axis)[peak[axis] - 1 : peak[axis] + 2]
            shift[axis] += (line[0] - line[2]) / 2 / (line[0] - 2 * line[1] + line[2])
    return shift


def enhanced(reference, image):
    """ECC over a pyramid, in OpenCV."""
    import cv2

    warp = np.eye(2, 3, dtype=np.float32)
    for level in (8, 4, 2, 1):
        small = [cv2.resize(i, None, fx=1 / level, fy=1 / level, interpolation=cv2.INTER_AREA)
                 for i in (reference, image)]  # fmt: skip
        here = warp.copy()
        here[:, 2] /= level
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
        try:
            here = cv2.findTransformECC(
                small[0], small[1], here, cv2.MOTION_TRANSLATION, stop, None, 5
            )[1]
        except cv2.error:  # it did not converge; a failure that the table counts
            continue
        warp[:, 2] = here[:, 2] * level
    return warp[::-1, 2]


def flow(reference, image):
    """The median of DIS optical flow, in OpenCV."""
    import cv2

    pair = [np.uint8(255 * np.clip(i / np.percentile(i, 99.5), 0, 1)) for i in (reference, image)]
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*pair, None)
    return np.median(dense[..., ::-1].reshape(-1, 2), 0)


def mutual(reference, image):
    """Mutual information, in SimpleITK, started from the correlation of gradients."""
    import SimpleITK

    fixed, moving = (SimpleITK.GetImageFromArray(i) for i in (reference, image))
    start = correlation(slopes(reference), slopes(image))
    transform = SimpleITK.TranslationTransform(2, start[::-1].tolist())
    method = SimpleITK.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(32)
    method.SetInterpolator(SimpleITK.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(0.5, 1e-3, 100)
    method.SetInitialTransform(transform)
    return np.array(method.Execute(fixed, moving).GetParameters())[::-1]


def on_slopes(shift: Callable) -> Callable:
    return lambda reference, image: shift(slopes(reference), slopes(image))


METHODS = {
    "squilla: one plane, all units": (squilla, None),
    "squilla, from the frame before": (squilla_again, None),
    "phase correlation, scikit-image": (pairwise(phase), "skimage:scikit-image"),
    "phase correlation on gradients": (pairwise(on_slopes(phase)), "skimage:scikit-image"),
    "NCC, scikit-image": (pairwise(correlation), "skimage:scikit-image"),
    "NCC on gradients": (pairwise(on_slopes(correlation)), "skimage:scikit-image"),
    "ECC pyramid on gradients, OpenCV": (
        pairwise(on_slopes(enhanced)), "cv2:opencv-python-headless"),
    "DIS flow on gradients, OpenCV": (pairwise(on_slopes(flow)), "cv2:opencv-python-headless"),
    "mutual information, SimpleITK": (pairwise(mutual), "SimpleITK:SimpleITK"),
}  # fmt: skip


def available() -> list[str]:
    """Return the methods whose libraries are here; say how to get the others."""
    names = []
    for name, (_, needs) in METHODS.items():
        module, _, package = (needs or "").partition(":")
        try:
            if module:
                __import__(module)
            names.append(name)
        except ImportError:
            print(f"{name}: not here; pip install {package}")
    return names


# --- the tables -----------------------------------------------------------------------------------


def run() -> None:
    done = json.loads(RESULTS.read_text())["cells"] if RESULTS.exists() else {}
    names = available()
    cells = [(s, d, t) for d in DISTANCES for t in TILTS for s in SCENES]
    every = [cell for cell in cells if cell[1] in COMPARED and cell[2] == (0, 0)]
    cells = every + [cell for cell in cells if cell not in every]  # the peers' first
    for number, (name, distance, tilt) in enumerate(cells):
        keys = {
            f"{name} {distance:g} mm {tilt[0]:g} {tilt[1]:g} deg {snr:g} dB": snr for snr in SNRS
        }
        wanted = names if (name, distance, tilt) in every else names[:2]
        if all(n in done.get(key, {}) for key in keys for n in wanted):
            continue
        seed = number % ARRAYS
        calibration = calibration_of(seed)
        lattice = calibration.lattice
        surface = plane(lattice, distance, tilt)
        truth = plane_map(surface, lattice) * lattice.baseline[..., None, None]
        images, offset = render(name, seed, surface)
        for key, snr in keys.items():
            electrons, noise, exposure = exposed(images, snr, number)
            done.setdefault(key, {})["bound"] = bound(
                exposure * images, noise, offset, lattice, surface
            )
            for method in wanted:
                if method in done.get(key, {}):
                    continue
                start = time.process_time()
                found, stated = METHODS[method][0](electrons, noise, calibration, offset)
                seconds = time.process_time() - start
                error = found - truth
                error = error - np.mean(error, 0)  # a shift of all units together is none
                each = np.sqrt(np.mean(error**2, (2, 3)).sum(1) / 2)  # per unit and axis
                done[key][method] = {
                    "rms": float(np.sqrt(np.mean(error**2))),
                    "median_unit": float(np.median(each)),
                    "failed": float(np.mean(each > 1)),
                    "cpu_seconds": seconds,
                    **stated,
                }
        RESULTS.write_text(json.dumps({"machine": machine(), "cells": done}, indent=1) + "\n")
        print(f"{number + 1}/{len(cells)} {name} {distance:g} mm {tilt}", flush=True)


def _compared(key: str) -> bool:
    return any(f" {distance:g} mm 0 0 deg" in key for distance in COMPARED)


def _total(cells: dict, method: str, snr: float) -> float:
    every = [v[method]["rms"] for k, v in cells.items() if k.endswith(f" {snr:g} dB")]
    return float(np.sqrt(np.mean(np.square(every))))


def machine() -> str:
    return f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}"


def report() -> None:
    cells = json.loads(RESULTS.read_text())["cells"]
    first, again = list(METHODS)[:2]
    print(f"\nsquilla, RMS px over units and field; {len(cells)} planes\n")
    print("| scene | 20 dB: median | worst | bound | 30 dB: median | worst | bound "
          "| stated within a factor of two |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
    for name in SCENES:
        columns, honest = [], []
        for snr in SNRS:
            some = [v for k, v in cells.items()
                    if k.startswith(name) and k.endswith(f" {snr:g} dB")]  # fmt: skip
            own = [v[first] for v in some]
            columns += [np.median([c["rms"] for c in own]), max(c["rms"] for c in own)]
            columns += [np.median([v["bound"] for v in some])]
            honest += [0.5 < (c["stated"] + 0.005) / (c["rms"] + 0.005) < 2 for c in own]
        print(f"| {name} |" + "".join(f" {c:.4f} |" for c in columns)
              + f" {sum(honest)} of {len(honest)} |")  # fmt: skip
    for method in (first, again):
        every = [_total(cells, method, snr) for snr in SNRS]
        print(f"\n{method}, all planes: RMS {every[0]:.4f} px at 20 dB, {every[1]:.4f} px at 30 dB")
    false = sum(v[first]["moved"] for v in cells.values())
    blind = sum(not v[first]["textured"] for v in cells.values())
    print(f"\ntaken for an array that has moved: {false}; for a scene without texture: {blind}")
    print("\nplanes that face the camera at 150 and 1000 mm, seven scenes, 36 units\n")
    print("| method | 20 dB: median unit, px | RMS, px | units off by > 1 px "
          "| 30 dB: median unit, px | RMS, px | units off by > 1 px | CPU s |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for method in METHODS:
        row, seconds = [], []
        for snr in SNRS:
            chosen = [v[method] for k, v in cells.items()
                      if _compared(k) and k.endswith(f" {snr:g} dB") and method in v]  # fmt: skip
            if not chosen:
                break
            row += [
                f"{np.median([c['median_unit'] for c in chosen]):.3f}",
                f"{np.sqrt(np.mean([c['rms'] ** 2 for c in chosen])):.3f}",
                f"{100 * np.mean([c['failed'] for c in chosen]):.1f} %",
            ]
            seconds += [c["cpu_seconds"] for c in chosen]
        if row:
            print(f"| {method} | " + " | ".join(row) + f" | {np.median(seconds):.2f} |")


def speed() -> None:
    """Print and keep the median time of each stage, cold and from the frame before."""
    twin = camera(0)
    design, lattice = twin.design, lattice_of(twin.design)
    pixels = Pixels(
        *(np.full(design.sensor_shape, v, np.float32) for v in (design.sensor.black_level, 0, 1)),
        np.ones(design.sensor_shape, bool), 4000.0, design.sensor.gain, design.sensor.read_noise,
    )  # fmt: skip
    calibration = Calibration(
        design.wavelength, twin.sensitivity([0.0]), np.zeros(1), lattice, pixels
    )
    raw = twin.capture(
        poster(300, WAVELENGTH, 3), distance=250, snr=30,
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    raw = Raw(raw.frame, raw.exposure)
    before = measure(raw, calibration)
    warm = np.array([before.provenance["disparity"], 0, 0])
    print(f"{torch.get_num_threads()} torch and {numba.get_num_threads()} numba threads, "
          f"{machine()}, load {os.getloadavg()[0]:.1f}\n")  # fmt: skip
    print("| stage | ms, median of 15 | CPU ms, least |\n|---|---|---|")

    spent: dict[str, float] = {}

    def timed(name: str, call: Callable):
        result, wall, work = call(), [], []
        for _ in range(15):
            start, busy = time.perf_counter(), time.process_time()
            call()
            wall.append(time.perf_counter() - start)
            work.append(time.process_time() - busy)
        spent[name] = 1000 * float(np.median(wall))
        print(f"| {name} | {spent[name]:.1f} | {1000 * min(work):.1f} |", flush=True)
        return result

    def planes(edges: Edges, first: np.ndarray, start: np.ndarray | None):
        with single_threaded_products():  # as in `measure`
            return find_plane(edges, lattice, first, (0, lattice.disparity(60)), start=start)

    for name, margin, start in (("cold", 46, None), ("warm", 26, warm + np.array([0.05, 0.01, 0]))):
        views = timed(f"{name}: correct the frame", lambda m=margin: sub_images(
            raw, lattice, pixels, m))  # fmt: skip
        noise = views.image.mean((1, 2)).numpy() / pixels.gain + 1
        edges = timed(f"{name}: gradients", lambda v=views, n=noise, s=start: find_edges(
            v.image.numpy(), v.bad.numpy(), n, step=2 if s is None else 4))  # fmt: skip
        timed(f"{name}: plane", lambda e=edges, v=views, s=start: planes(
            e, v.margin + v.offset, s))  # fmt: skip
        found = sum(
            spent[f"{name}: {part}"] for part in ("correct the frame", "gradients", "plane")
        )
        print(f"| **{name}: found, in all** | **{found:.1f}** | |")
        flat = plane_map(warm, lattice)
        timed(f"{name}: resample", lambda v=views, f=flat: align(v, lattice, f))
    timed("measure, cold", lambda: measure(raw, calibration))
    timed("measure, from the frame before", lambda: measure(raw, calibration, start=before))
    story = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps(story | {"milliseconds": spent}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--speed", action="store_true", help="times alone")
    parser.add_argument("--report", action="store_true", help="print the tables again")
    chosen = parser.parse_args()
    if chosen.speed:
        speed()
        return
    if not chosen.report:
        run()
    report()


if __name__ == "__main__":
    main()
