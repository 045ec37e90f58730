"""Many captures on a Dask cluster of this machine, beside one after the other.

Usage: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/batch.py

200 captures of the thesis' optics on pixels twice as wide (1500 x 2000 px, 36 sub-images of 124 x
124 px, 51 bands) become one Zarr by `ridge`: in one loop, and through a `dask scheduler` with two
`dask worker` processes. Twenty captures are different, the others the same under other names.
Prints whether the cubes are equal to the last bit, the peak memory of each process for 100 and for
200 captures, and the captures per second and core, the best of three turns: beside one loop, beside
two at once, and by the processor time of the workers. Writes experiments/results/batch.json; four
minutes on two cores.
"""

import json
import os
import platform
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import xarray as xr

from squilla.batch.captures import Recipe, reconstruct_all
from squilla.files.raw import list_frames, write_raw

RESULTS = Path(__file__).parents[1] / "experiments" / "results" / "batch.json"
WORK = Path(tempfile.gettempdir()) / "squilla-batch"
DIFFERENT, COUNTS, TURNS = 20, (100, 200), 3


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
    summary = reconstruct_all(list_frames(WORK / f"{max(COUNTS)}")[:count], recipe, output, **how)
    assert len(summary.done) == count, summary.failed
    return time.perf_counter() - start


@contextmanager
def cluster() -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """Lend the address of a scheduler with two workers that are warm, and the three processes."""
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
            # The workers load squilla and compile before any clock starts, as the loops do.
            timed(DIFFERENT, "warm", scheduler=address)
            yield address, processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def on_cluster(count: int, name: str, address: str, processes: list[subprocess.Popen]) -> dict:
    """Reconstruct on the workers."""
    before = sum(worked(process.pid) for process in processes[1:])
    seconds = timed(count, name, scheduler=address)
    taken = sum(worked(process.pid) for process in processes[1:]) - before
    return {"seconds": seconds, "processor_seconds": taken}


def memory(count: int) -> dict:
    """Return the peak memory of each process of a fresh cluster, MB."""
    with cluster() as (address, processes):
        on_cluster(count, f"dask{count}", address, processes)
        peaks = [peak(process.pid) for process in processes]
    each = {"scheduler": peaks[0], "workers": peaks[1:], "run": peak("self")}
    return each | {"all": sum(peaks) + each["run"]}


def loop(count: int, name: str) -> dict:
    """Reconstruct one after the other in this process."""
    before = worked(os.getpid())
    seconds = timed(count, name, workers=1)
    return {"seconds": seconds, "processor_seconds": worked(os.getpid()) - before}


def by_turns(count: int) -> dict[str, list[dict]]:
    """Run one loop, two loops at once, and the cluster by turns, that a busy moment hurts all.

    Two loops that know nothing of each other show what two cores of this machine give, which
    share its memory and its disk.
    """
    found: dict[str, list[dict]] = {"one loop": [], "two loops": [], "cluster": []}
    spawn = get_context("spawn")
    with spawn.Pool(1) as one, spawn.Pool(1) as other, cluster() as (address, processes):
        pools = one, other
        for pool, name in zip(pools, "ab", strict=True):
            pool.apply(loop, (DIFFERENT, name))
        for _ in range(TURNS):
            found["one loop"].append(one.apply(loop, (count, "a")))
            both = [
                pool.apply_async(loop, (count // 2, name))
                for pool, name in zip(pools, "ab", strict=True)
            ]
            halves = [each.get() for each in both]
            found["two loops"].append(
                {
                    "seconds": max(each["seconds"] for each in halves),
                    "processor_seconds": sum(each["processor_seconds"] for each in halves),
                }
            )
            found["cluster"].append(on_cluster(count, "turn", address, processes))
    return found


def main() -> None:
    with get_context("spawn").Pool(1) as apart:  # whose memory is not counted
        apart.apply(make_captures)
    results: dict = {f"memory_mb {count}": memory(count) for count in COUNTS}
    most = max(COUNTS)
    with get_context("spawn").Pool(1) as apart:
        results["serial"] = apart.apply(loop, (most, "serial"))
    one, two = (
        xr.open_zarr(WORK / f"{name}.zarr", consolidated=False).radiance
        for name in ("serial", f"dask{most}")
    )
    results["bit_equal"] = all(
        np.array_equal(one[place].values, two[place].values, equal_nan=True)
        for place in range(most)
    )
    turns = results["turns"] = by_turns(COUNTS[0])
    least = {
        key: {name: min(each[key] for each in taken) for name, taken in turns.items()}
        for key in ("seconds", "processor_seconds")
    }
    wall, work = least["seconds"], least["processor_seconds"]
    results["per_core"] = {
        "captures_per_second_one_loop": COUNTS[0] / wall["one loop"],
        "captures_per_second_two_loops": COUNTS[0] / wall["two loops"] / 2,
        "captures_per_second_cluster": COUNTS[0] / wall["cluster"] / 2,
        "cluster_over_one_loop": wall["one loop"] / wall["cluster"] / 2,
        "cluster_over_two_loops": wall["two loops"] / wall["cluster"],
        "cluster_over_one_loop_by_processor_time": work["one loop"] / work["cluster"],
    }
    results["machine"] = f"{platform.machine()}, {os.cpu_count()} cores"
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
