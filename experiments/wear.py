"""What wear of a camera costs, whether it is noticed, and what is left of its error afterwards.

Usage: python experiments/wear.py [--write]

The thesis' camera, calibrated from its twin's frames (experiments/work/camera.nc, made if it is not
there), ages in one way after another and photographs the corn kernels at 30 dB.
`before` is the error of the cube where nobody looks for wear; `after` with what `measure` finds in
that one frame; `checked` after `squilla.calibration.check` has seen four flats and darks of that
day. Writes experiments/results/wear.json, fault by fault; --write renders docs/wear.md from it.
"""

import json
import sys
import warnings
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import thesis
import torch

from squilla.calibration.agreement import Agreement
from squilla.calibration.alignment import measure
from squilla.calibration.check import check
from squilla.calibration.pixels import Darks, Stack, noise_of
from squilla.calibration.rehearsal import Rehearsal
from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.camera.wear import Dust, Wear, WornCamera, drop_rows
from squilla.reconstruction.judgement import judge, told_of
from squilla.reconstruction.models import load_model

RESULTS = Path(__file__).parent / "results" / "wear.json"
PAGE = Path(__file__).parents[1] / "docs" / "wear.md"
SNR = 30.0

FAULTS = {
    "none": Wear(),
    "one unit covered": Wear(dust=(Dust(3),)),
    "dust: a lens at 80 %": Wear(dust=(Dust(9, transmittance=0.8),)),
    "dust: a speck of 40 px": Wear(dust=(Dust(20, (40, 20), 40, 0.3),)),
    "a thousandth of the pixels hot": Wear(hot_pixels=1e-3),
    "sensor 40 K warmer": Wear(warmer=40.0),
    "light leaks in": Wear(leak=10.0),
    "filters 1 nm to the red": Wear(drift=1.0),
    "80 rows empty": Wear(),
    "80 rows stale": Wear(),
}


@contextmanager
def nobody_looks():
    """Let `measure` look for no wear, as it would be without."""
    module = "squilla.calibration.alignment."
    sound = Agreement(np.ones(36), np.zeros(36, bool))
    with ExitStack() as stack:
        for name, instead in (
            ("without_lost_rows", lambda raw, pixels: (pixels, 0)),
            ("without_veil", lambda raw, pixels: (pixels, 0.0)),
            ("without_odd_pixels", lambda views, pixels: (views, 0)),
            ("without_covered_units", lambda views: views),
            ("compare", lambda *given, **more: sound),
        ):
            stack.enter_context(patch(module + name, instead))
        yield


def error(cube, truth: np.ndarray) -> float:
    """Return the RMS error against the RMS of the truth."""
    return float(np.sqrt(np.nanmean((cube.values - truth) ** 2) / np.mean(truth**2)))


def of(kind: str, wear: Wear) -> dict:
    calibration = thesis.camera()
    camera = WornCamera("thesis", wear)
    scene = load_scene("corn-kernel", camera.design.wavelength, camera.design.field.size)
    sound = Camera("thesis")
    exposure = sound.sensor.exposure_for(sound.fields(sound.rate(scene)), SNR)
    raw = camera.expose(camera.rate(scene), exposure, torch.Generator().manual_seed(3))
    if "rows" in kind:
        raw = drop_rows(raw, 1270, 80, repeated="stale" in kind)
    truth = camera.truth(scene).cube.values
    found: dict = {}
    mended, says = calibration, []
    if "rows" not in kind:  # those are of one frame, and no wear that flats could show
        rehearsal = Rehearsal(camera, seed=9, frames=4)
        today = check(calibration, dark=rehearsal.dark(), flat=rehearsal.flat())
        mended, says = today.mended(calibration), today.says
        found["drift"] = [today.drift, today.drift_error]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for name, own in (("after", calibration), ("checked", mended)):
            measurement = measure(raw, own)
            cube = load_model("ridge", own).reconstruct(measurement)
            found[name] = error(cube, truth)
            if name == "after":
                found["says"] = [str(each.message) for each in told]
                found["residual"] = told_of(judge(cube, measurement, own))
        with nobody_looks():
            cube = load_model("ridge", calibration).reconstruct(measure(raw, calibration))
    found["before"] = error(cube, truth)
    found["check_says"] = says
    return found


def flickering() -> dict:
    """Return the gain that flats teach whose lamp changes by up to 5 % from frame to frame."""
    camera = Camera("thesis")
    rehearsal = Rehearsal(camera, frames=8)
    darks = Darks.of(rehearsal.dark())
    rate = camera.flat_rate(np.ones(len(camera.design.wavelength)))
    exposure = 0.7 * camera.design.sensor.full_well / float(rate.max())
    level = 1 + 0.05 * np.sin(np.arange(8.0))

    def flats():
        for number, share in enumerate(level):
            yield camera.expose(rate * share, exposure, torch.Generator().manual_seed(number))

    lit = rate > 0.5 * rate.max()
    blind, seeing = Stack.of(flats(), "flat"), Stack.of(flats(), "flat", darks)
    return {
        "true": camera.design.sensor.gain,
        "before": noise_of(darks.shortest, blind, lit)[0],
        "after": noise_of(darks.shortest, seeing, lit)[0],
        "light_change": seeing.light_change,
    }


def page(results: dict) -> str:
    """Return docs/wear.md."""
    sound = results["none"]["after"]
    rows = []
    for kind in FAULTS:
        if kind == "none" or kind not in results:
            continue
        one = results[kind]
        frame = "the frame" if one["says"] else "-"
        flats = "flats" if one["check_says"] else "-"
        by = " and ".join(each for each in (frame, flats) if each != "-") or "not"
        rows.append(
            f"| {kind} | {by} | {one['before']:.4f} | {one['after']:.4f} | {one['checked']:.4f} |"
        )
    lamp = ""
    if "flats in a flickering lamp" in results:
        light = results["flats in a flickering lamp"]
        lamp = (
            f" A lamp that changes by {light['light_change']:.0%} between the flats made the gain "
            f"{light['before']:.2f} e-/DN instead of {light['true']:.2f}; evened out, it is "
            f"{light['after']:.2f}."
        )
    said = [f"- {kind}: {' '.join(results[kind]['says'])}" for kind in FAULTS if kind in results
            and results[kind]["says"]]  # fmt: skip
    text = PAGE.read_text()
    begin, end = "<!-- table -->", "<!-- end -->"
    table = "\n".join(
        [
            "| fault | noticed by | before | after | checked |",
            "|---|---|---|---|---|",
            *rows,
            "",
            f"Without any fault the error is {sound:.4f}.{lamp}",
            "",
            "What `measure` says of each:",
            "",
            *said,
        ]
    )
    head, rest = text.split(begin)
    return head + begin + "\n" + table + "\n" + end + rest.split(end)[1]


def main() -> None:
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for kind, wear in FAULTS.items():
        if kind not in results:
            results[kind] = of(kind, wear)
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")
        print(kind, results[kind], flush=True)
    if "flats in a flickering lamp" not in results:
        results["flats in a flickering lamp"] = flickering()
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(results["flats in a flickering lamp"])
    if "--write" in sys.argv:
        PAGE.write_text(page(results))


if __name__ == "__main__":
    main()
