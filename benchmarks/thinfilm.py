"""Time the transfer matrix beside the tmm package: 36 filters of 19 layers at 251 wavelengths.

Usage: python benchmarks/thinfilm.py [threads]
"""

import importlib.util
import sys
import time
from statistics import median

import numpy as np
import torch
from tmm import coh_tmm

from squilla.optics.filters import StencilRecipe
from squilla.optics.materials import refractive_index
from squilla.optics.thinfilm import transmittance
from squilla.spectra import grid


def seconds(call, repeats):
    """Return the median time of a call after one to warm up, and its result."""
    result, times = call(), []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return median(times), result


def main(threads: int = 1) -> None:
    torch.set_num_threads(threads)
    wavelength = grid()
    filters = StencilRecipe().draw(0)
    thickness = filters.stacks.flip(-1)
    index = np.stack([refractive_index(name, wavelength) for name in filters.material[::-1]])
    glass = refractive_index(filters.substrate, wavelength)
    print(
        f"{len(thickness)} stacks of {thickness.shape[-1]} layers, {len(wavelength)} wavelengths,"
    )
    print(f"torch {torch.__version__}, {threads} thread(s); median times\n")

    def loop(polarization, angle):
        return [
            [
                coh_tmm(polarization, [1, *n, back], [np.inf, *stack, np.inf], angle, lam)["T"]
                for lam, n, back in zip(wavelength, index.T, glass, strict=True)
            ]
            for stack in thickness.tolist()
        ]

    def report(name, angle, polarization, theirs, expected):
        ours, result = seconds(
            lambda: transmittance(
                index,
                thickness,
                wavelength,
                substrate=glass,
                angle=angle,
                polarization=polarization,
            ),
            50,
        )
        line = f"{name:28s} squilla {1e3 * ours:8.2f} ms"
        if theirs is not None:
            difference = np.abs(result.numpy() - np.array(expected)).max()
            line += f"   tmm {theirs:6.2f} s   {theirs / ours:6.0f} times   differ {difference:.0e}"
        print(line)

    for name, angle, polarization in (("normal incidence", 0.0, "s"), ("9 degrees, p", 0.157, "p")):
        theirs, expected = seconds(lambda a=angle, p=polarization: loop(p, a), 3)
        report(name, angle, polarization, theirs, expected)
    report("20 angles, unpolarized", np.linspace(0, 0.28, 20), "unpolarized", None, None)

    free = (thickness + torch.rand(thickness.shape)).requires_grad_()

    def gradient():
        transmittance(index, free, wavelength, substrate=glass).sum().backward()

    print(f"{'gradient, all layers differ':28s} squilla {1e3 * seconds(gradient, 20)[0]:8.2f} ms")
    if importlib.util.find_spec("tmm_fast"):
        from tmm_fast import coh_tmm as coh_tmm_fast

        half_space = np.full((len(thickness), 1), np.inf)
        layers = np.concatenate([half_space, thickness.numpy(), half_space], 1)
        n = np.concatenate([np.ones((1, len(wavelength))), index, glass[None]])
        n = np.broadcast_to(n, (len(layers), *n.shape))
        fast, _ = seconds(lambda: coh_tmm_fast("s", n, layers, np.zeros(1), wavelength), 10)
        print(f"{'normal incidence':28s} tmm_fast {1e3 * fast:7.2f} ms")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
