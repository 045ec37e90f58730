"""Many captures on a Dask cluster of this machine, beside one after the other.

Usage: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/batch.py

200 captures of the thesis' optics on pixels twice as wide (1500 x 2000 px, 36 sub-images of 124 x
124 px, 51 bands) become one Zarr by `ridge`: in one loop, and through a `dask scheduler` with two
`dask worker` processes. Twenty captures are different, the others the same under other names.
Prints whether the cubes are equal to the last bit, the peak memory of each process for 100 and for
200 captures, and the captures per second and core: by the clock, and by the processor time that the
workers took, which other programs on the machine do not change. Writes
experiments/results/batch.json.
"""

import json
import os
import platform
import socket
import subprocess
import sys
import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import xarray as xr

from squilla.batch.captures import Recipe, reconstruct_all
from squilla.files.raw import list_frames, write_raw

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "batch.json"
WORK = Path(tempfile.gettempdir()) / "squilla-batch"
DIFFERENT, COUNTS = 20, (100, 200)


def make_captures() -> None:
    """Lay out the captures and their calibration, once."""
    if (WORK / "camera.nc").exists():
        return
    import torch

    from squilla.calibration.rehearsal import ideal_calibration
    from squilla.camera.design import CameraDesign
    from squilla.camera.scenes import load_scene
    from squilla.camera.twin import Camera

    tree = CameraDesign.load("thesis").model_dump()
    tree["band"] |= {"step": 5.0}
    tree["sensor"] |= {"pixel": 3.7, "rows": 1500, "columns": 2000}
    tree["field"] |= {"size": 124}
    camera = Camera(CameraDesign.model_validate(tree))
    for count in (*COUNTS, DIFFERENT):
        (WORK / f"{count}").mkdir(parents=True, exist_ok=True)
    rate = camera.rate(load_scene("corn-kernel", camera.design.wavelength, 124))
    exposure = camera.sensor.exposure_for(camera.fields(rate), 25.0)
    for number in range(max(COUNTS)):
        for count in (*COUNTS, DIFFERENT):
            path = WORK / f"{count}" / f"shot{number}.tiff"
            path.unlink(missing_ok=True)
            if number >= count:
                continue
            if number < DIFFERENT and count == COUNTS[0]:
                generator = torch.Generator().manual_seed(number)
                write_raw(path, camera.expose(rate, exposure, generator))
            else:
                os.link(WORK / f"{COUNTS[0]}" / f"shot{number % DIFFERENT}.tiff", path)
    ideal_calibration(camera).save(WORK / "camera.nc")


def peak(process: int | str) -> float:
    """Return the largest memory that a process has had, MB."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return float("nan")


def worked(process: int) -> float:
    """Return the processor time that a process has taken, s; whatever else the machine does."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def timed(count: int, name: str, **how) -> float:
    """Reconstruct captures anew; return the seconds that it took."""
    output = WORK / f"{name}.zarr"
    subprocess.run(["rm", "-rf", output, output.with_suffix(".journal.jsonl")], check=True)
    start = time.perf_counter()
    recipe = Recipe(WORK / "camera.nc", "ridge")
    summary = reconstruct_all(list_frames(WORK / f"{count}"), recipe, output, **how)
    assert len(summary.done) == count, summary.failed
    return time.perf_counter() - start


def on_cluster(count: int) -> dict:
    """Reconstruct on two fresh workers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        # Dask looks where each worker is a hundred times a second; that costs a seventh.
        "env": os.environ | {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"},
    }
    dask = [sys.executable, "-m", "dask"]
    place = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    alone = ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(WORK)]
    processes = [subprocess.Popen([*dask, "scheduler", *place], **quiet)]
    processes += [subprocess.Popen([*dask, "worker", address, *alone], **quiet) for _ in range(2)]
    try:
        from distributed import Client

        with Client(address, timeout=60) as client:
            client.wait_for_workers(2, timeout=60)
            # The workers load squilla and compile before the clock starts, as the loop did.
            timed(DIFFERENT, "warm", scheduler=address)
            before = sum(worked(process.pid) for process in processes[1:])
            seconds = timed(count, f"dask{count}", scheduler=address)
            taken = sum(worked(process.pid) for process in processes[1:]) - before
        memory = [peak(process.pid) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    return {
        "seconds": seconds,
        "processor_seconds": taken,
        "scheduler_mb": memory[0],
        "worker_mb": memory[1:],
        "run_mb": peak("self"),
    }


def loop(count: int) -> dict:
    """Reconstruct one after the other in this process."""
    timed(DIFFERENT, "warm", workers=1)
    before = worked(os.getpid())
    seconds = timed(count, "serial", workers=1)
    taken = worked(os.getpid()) - before
    return {"seconds": seconds, "processor_seconds": taken, "run_mb": peak("self")}


def main() -> None:
    with get_context("spawn").Pool(1) as apart:  # whose memory is not counted
        apart.apply(make_captures)
    most = max(COUNTS)
    results: dict = {f"dask {count}": on_cluster(count) for count in COUNTS}
    results[f"serial {most}"] = loop(most)
    one, two = (
        xr.open_zarr(WORK / f"{name}.zarr", consolidated=False).radiance
        for name in ("serial", f"dask{most}")
    )
    equal = all(
        np.array_equal(one[place].values, two[place].values, equal_nan=True)
        for place in range(most)
    )
    alone, shared = (results[name] for name in (f"serial {most}", f"dask {most}"))
    memory = [
        results[name]["scheduler_mb"] + sum(results[name]["worker_mb"]) + results[name]["run_mb"]
        for name in (f"dask {count}" for count in COUNTS)
    ]
    results["summary"] = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "bit_equal": equal,
        "memory_mb": memory,
        "captures_per_second_loop": most / alone["seconds"],
        "captures_per_second_per_core": most / shared["seconds"] / 2,
        "per_core_against_loop": alone["seconds"] / shared["seconds"] / 2,
        "per_processor_second_against_loop": alone["processor_seconds"]
        / shared["processor_seconds"],
    }
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
