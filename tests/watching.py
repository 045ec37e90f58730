"""What the page does with a live view, quick to start: ``python watching.py ADDRESS SECONDS``.

Watches colour, three bands and the spectra of two points and a region, acknowledges each frame,
and prints the times (s) at which frames were complete and what was told of their stages, as JSON.
"""

import json
import sys
import time

from websockets.sync.client import connect

BANDS = (160, 80, 0)  # 660, 580, 500 nm of 251 bands
PLACES = [[100, 100, 101, 101], [20, 200, 21, 201], [120, 60, 130, 70]]
WARM = 5  # frames before the clock starts


def watch(address: str, seconds: float) -> tuple[list[float], list[dict]]:
    """Return when frames were complete, and the stages that were told of each."""
    origin = f"http://{address}"
    with connect(f"ws://{address}/socket", origin=origin, compression=None, max_size=None) as line:
        return _watched(line, seconds)


def _watched(line, seconds: float) -> tuple[list[float], list[dict]]:
    pictures = [{"kind": "colour"}, *({"kind": "band", "band": band} for band in BANDS)]
    wanted = [*pictures, {"ask": "spectra", "regions": PLACES}]
    line.recv()
    line.send(json.dumps({"ask": "watch", "wanted": wanted}))
    times, stages, end = [], [], float("inf")
    while time.perf_counter() < end:
        message = line.recv(timeout=60)
        header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
        assert "error" not in header, header
        if not header.get("last"):
            continue
        line.send(json.dumps({"ask": "acknowledge", "frame": header["frame"]}))
        times.append(time.perf_counter())
        stages.append(header["status"]["stages"])
        if end == float("inf") and len(times) == WARM:
            end, times, stages = time.perf_counter() + seconds, times[-1:], []
    return times, stages


if __name__ == "__main__":
    print(json.dumps(watch(sys.argv[1], float(sys.argv[2]))))
