"""Time the transfer matrix beside what else there is: the tmm package and, if present, tmm_fast.

Usage: python benchmarks/thinfilm.py [threads]

tmm_fast is not asked for by squilla; `pip install --no-deps tmm_fast` leaves torch as it is.
"""

import importlib.util
import sys

import numpy as np
import torch
from timing import seconds
from tmm import coh_tmm

from squilla.optics.design import together
from squilla.optics.filters import StencilRecipe
from squilla.optics.materials import refractive_index
from squilla.optics.merit import Prior, WhiteNoise, expected_error
from squilla.optics.thinfilm import transmittance
from squilla.optics.tolerance import ProcessErrors, tolerance
from squilla.spectra import grid

ANGLES = np.linspace(0, 0.28, 8)


def timed(call, repeats):
    """Return the median time of a call and its result."""
    return seconds(call, repeats), call()


def main(threads: int = 1) -> None:
    torch.set_num_threads(threads)
    wavelength = grid()
    filters = StencilRecipe().draw(0)
    stacks = filters.stacks.flip(-1)
    index = np.stack([refractive_index(name, wavelength) for name in filters.material[::-1]])
    glass = refractive_index(filters.substrate, wavelength)
    print(f"{len(stacks)} stacks of {stacks.shape[-1]} layers, {len(wavelength)} wavelengths,")
    print(f"torch {torch.__version__}, {threads} thread(s); median times\n")

    def ours(angle, polarization, repeats):
        """The stacks as a stencil makes them: thicknesses shared, layers left out."""
        return timed(
            lambda: transmittance(
                index, filters.thickness.flip(-1), wavelength, layers=filters.layers.flip(-1),
                substrate=glass, angle=angle, polarization=polarization,
            ),
            repeats,
        )  # fmt: skip

    def loop(polarization, angle):
        return [
            [
                coh_tmm(polarization, [1, *n, back], [np.inf, *stack, np.inf], angle, lam)["T"]
                for lam, n, back in zip(wavelength, index.T, glass, strict=True)
            ]
            for stack in stacks.tolist()
        ]

    def compare(name, angle, polarization, others):
        own, result = ours(angle, polarization, 30)
        print(f"{name:28s} squilla  {1e3 * own:9.2f} ms")
        for who, call, repeats in others:
            theirs, expected = timed(call, repeats)
            difference = np.abs(result.numpy() - np.asarray(expected)).max()
            print(
                f"{'':28s} {who:8s} {1e3 * theirs:9.2f} ms   {theirs / own:6.1f} times as long, "
                f"differs by {difference:.0e}"
            )

    normal = [("tmm", lambda: loop("s", 0.0), 3)]
    slanted = [("tmm", lambda: loop("p", 0.157), 3)]
    cone = []
    if importlib.util.find_spec("tmm_fast"):
        from tmm_fast import coh_tmm as coh_tmm_fast

        half_space = np.full((len(stacks), 1), np.inf)
        layers = np.concatenate([half_space, stacks.numpy(), half_space], 1)
        n = np.concatenate([np.ones((1, len(wavelength))), index, glass[None]])
        n = np.broadcast_to(n, (len(layers), *n.shape))

        def fast(polarization, angle):
            return coh_tmm_fast(polarization, n, layers, np.atleast_1d(angle), wavelength)["T"]

        normal.append(("tmm_fast", lambda: fast("s", 0.0)[:, 0], 10))
        slanted.append(("tmm_fast", lambda: fast("p", 0.157)[:, 0], 10))
        cone.append(("tmm_fast", lambda: (fast("s", ANGLES) + fast("p", ANGLES)) / 2, 5))
    compare("normal incidence", 0.0, "s", normal)
    compare("9 degrees, p", 0.157, "p", slanted)
    compare("8 angles, unpolarized", ANGLES, "unpolarized", cone)

    for name, thickness in (("shared", filters.thickness), ("all different", filters.stacks)):
        free = thickness.flip(-1).requires_grad_()

        def gradient(free=free):
            through = transmittance(
                index, free, wavelength, layers=filters.layers.flip(-1), substrate=glass
            )
            through.sum().backward()

        label = f"gradient, thickness {name}"
        print(f"{label:37s} {1e3 * seconds(gradient, 20):9.2f} ms")

    print("\nwhole arrays with the back of the glass, arrays per minute")
    many = together([StencilRecipe().draw(seed) for seed in range(100)])
    for name, angle, repeats in (
        ("normal incidence", 0.0, 3),
        ("8 angles, unpolarized", ANGLES, 1),
    ):
        each, response = timed(lambda a=angle: many.transmittance(wavelength, a), repeats)
        print(f"{name:28s} {60 * 100 / each:9.0f}")
    prior, response = Prior.draw("natural"), many.transmittance(wavelength)
    each = seconds(lambda: expected_error(response, prior, noise=WhiteNoise(20)), 3)
    print(f"{'their expected error':28s} {60 * 100 / each:9.0f}")
    faults = ProcessErrors(scale=0.01, deposition=0.01)
    each = seconds(lambda: tolerance(filters, faults, prior, noise=WhiteNoise(20), count=100), 3)
    print(f"{'coated with faults, judged':28s} {60 * 100 / each:9.0f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
