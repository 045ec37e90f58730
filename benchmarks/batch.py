"""Many captures on a Dask cluster of this machine, beside one after the other.

Usage: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/batch.py

200 captures of the thesis' optics on pixels twice as wide (1500 x 2000 px, 36 sub-images of 124 x
124 px, 51 bands) become one Zarr by `ridge`: in one loop, and through a `dask scheduler` with two
`dask worker` processes. Twenty captures are different, the others the same under other names.
Prints whether the cubes are equal to the last bit, the peak memory of each process for 100 and for
200 captures, and the captures per second of processor time: the throughput per core also
where a machine does other things too. Writes experiments/results/batch.json; a part
that is there is not done again.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import xarray as xr

from squilla.batch import Recipe, reconstruct_all
from squilla.calibration.rehearsal import ideal_calibration
from squilla.camera.design import CameraDesign
from squilla.camera.scenes import load_scene
from squilla.camera.twin import Camera
from squilla.files.raw import list_frames, write_raw

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "batch.json"
WORK = Path(tempfile.gettempdir()) / "squilla-batch"
DIFFERENT, COUNTS = 20, (100, 200)


def make_captures() -> None:
    if (WORK / "camera.nc").exists():
        return
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
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
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


def main() -> None:
    # Beside this script lies one named as a package that Dask looks for.
    sys.path.remove(str(Path(__file__).parent))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}

    def keep(name: str, work) -> None:
        if name not in results:
            results[name] = work()
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")
        print(name, results[name], flush=True)

    make_captures()
    for count in COUNTS:
        keep(f"dask {count}", lambda count=count: on_cluster(count))

    def loop() -> dict:
        timed(DIFFERENT, "warm", workers=1)
        before = worked(os.getpid())
        seconds = timed(COUNTS[1], "serial", workers=1)
        taken = worked(os.getpid()) - before
        return {"seconds": seconds, "processor_seconds": taken, "run_mb": peak("self")}

    keep("serial 200", loop)
    one, two = (
        xr.open_zarr(WORK / f"{name}.zarr", consolidated=False).radiance
        for name in ("serial", "dask200")
    )
    equal = all(
        np.array_equal(one[place].values, two[place].values, equal_nan=True)
        for place in range(COUNTS[1])
    )
    loop_time, dask_time = (
        results[name]["processor_seconds"] for name in ("serial 200", "dask 200")
    )
    results["summary"] = {
        "bit_equal": equal,
        "captures_per_processor_second": {
            "loop": COUNTS[1] / loop_time,
            "dask": COUNTS[1] / dask_time,
        },
        "dask_against_loop": loop_time / dask_time,
        "cores": os.cpu_count(),
    }
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(results["summary"])


if __name__ == "__main__":
    main()
