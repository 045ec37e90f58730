"""Feed every reader with bytes that coverage leads (Atheris), and keep what is found.

Usage: python tests/fuzz/run.py [--seconds 60] [--readers raw-tiff,calibration]

`pip install atheris` (Linux, Python 3.11 to 3.13). Each reader works in a process of its own, from
its seeds, the kept corpus and what it found before. An input that raises anything but an InputError
is put into ``corpus/<reader>/`` and the run goes on; one that hangs for 20 s or takes 2 GiB ends
that reader and is left as ``timeout-*`` or ``oom-*``. Counts are added to
experiments/results/fuzz.json, so that a run that was stopped goes on.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "experiments" / "results" / "fuzz.json"
WORK = Path(tempfile.gettempdir()) / "squilla-fuzz"


def read_results() -> dict:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def write_results(results: dict) -> None:
    temporary = RESULTS.with_suffix(".part")
    temporary.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    temporary.replace(RESULTS)


def fuzz(reader: str, seconds: int) -> None:
    """Work on one reader in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=["squilla", "tifffile", "spectral", "tomllib"]):
        sys.path.insert(0, str(Path(__file__).parent))
        from targets import CORPUS, TARGETS, prepare, run

    target = TARGETS[reader]
    shared = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
    folder = Path(tempfile.mkdtemp(dir=shared))
    prepare(target, folder)
    grown = WORK / reader
    grown.mkdir(parents=True, exist_ok=True)
    kept = CORPUS / reader
    for number, seed in enumerate(target.seeds()):
        (grown / f"seed{number}").write_bytes(seed)
    for file in kept.glob("*") if kept.is_dir() else []:
        (grown / file.name).write_bytes(file.read_bytes())
    count, taken, seen = 0, 0, set()

    def tell() -> None:
        (WORK / f"{reader}.json").write_text(json.dumps({"runs": count, "taken": taken}))

    def one(data: bytes) -> None:
        nonlocal count, taken
        count += 1
        if count % 200 == 0:
            tell()
        try:
            taken += run(target, data, folder)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = (type(error).__name__, last.filename, last.lineno)
            if place not in seen:
                seen.add(place)
                kept.mkdir(parents=True, exist_ok=True)
                name = f"{type(error).__name__}-{hashlib.sha256(data).hexdigest()[:8]}"
                (kept / name).write_bytes(data)
                print(f"FOUND {reader}: {error!r}", file=sys.stderr, flush=True)
                traceback.print_exc()

    os.chdir(WORK)
    options = [
        f"-max_total_time={seconds}", "-timeout=20", "-rss_limit_mb=2048", "-max_len=6000",
        "-verbosity=0", f"-artifact_prefix={WORK}/{reader}-", str(grown),
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=60, help="for each reader")
    parser.add_argument("--readers", default="", help="names, with commas; default all")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        fuzz(given.one, given.seconds)
        return
    sys.path.insert(0, str(Path(__file__).parent))
    from targets import TARGETS

    WORK.mkdir(exist_ok=True)
    for reader in given.readers.split(",") if given.readers else TARGETS:
        told = WORK / f"{reader}.json"
        told.unlink(missing_ok=True)
        command = [sys.executable, __file__, "--one", reader, "--seconds", str(given.seconds)]
        ended = subprocess.run(command, capture_output=True, text=True)
        counts = json.loads(told.read_text()) if told.exists() else {"runs": 0, "taken": 0}
        found = [line for line in ended.stderr.splitlines() if line.startswith("FOUND")]
        bad = [line for line in ended.stderr.splitlines() if "ERROR: libFuzzer" in line]
        results = read_results()
        entry = results.setdefault(reader, {"runs": 0, "taken": 0, "seconds": 0})
        for key in ("runs", "taken"):
            entry[key] += counts[key]
        entry["seconds"] += given.seconds
        write_results(results)
        print(f"{reader:16} {counts['runs']:8} runs", *found, *bad, flush=True)
        (WORK / f"{reader}.log").write_text(ended.stderr[-20000:])
    print("in all:", sum(entry["runs"] for entry in read_results().values()))


if __name__ == "__main__":
    main()
