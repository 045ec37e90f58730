"""The search for a good filter array: many at random, then masks exchanged and layers refined.

Within the limits of a process: each thickness stays on its interval, a deposition that filters
share stays shared, and a mask leaves out as many layers as the recipe says.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Generator, Tensor

from squilla.errors import InputError
from squilla.optics.filters import FilterArray

BATCH = 64
"""Arrays whose merit is taken at once."""

CANDIDATES = 256
"""Other masks among which each exchange takes the best."""

Merit = Callable[[Tensor], Tensor]
"""From transmittances (..., M, K) to what shall be least, (...), with a gradient."""


class Recipe(Protocol):
    """What a process can make; `squilla.optics.filters` has several."""

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Least and greatest thickness of each deposition, (L,) nm."""
        ...

    def draw(self, seed: int | Generator = 0) -> FilterArray:
        """Draw an array."""
        ...

    def masks(self, count: int, generator: Generator) -> Tensor | None:
        """Draw ways to make one filter, (count, L) bool; None where there is nothing to choose.

        There is only where all filters share their thicknesses.
        """
        ...


class Step(NamedTuple):
    """One step of a search: what was done, and the merit of the best array then."""

    stage: str
    merit: float


@dataclass(frozen=True, eq=False)
class Search:
    """What a search found.

    array : the best array.
    merit : its figure.
    first : the best of the arrays drawn at random.
    drawn : (N,) merits of the arrays drawn at random.
    history : one step for each array drawn and each round of improvement, in order.
    """

    array: FilterArray
    merit: float
    first: FilterArray
    drawn: Tensor
    history: list[Step]


Progress = Callable[[str, int, int, float], None]
"""Called with the stage, how many of its steps are done, of how many, and the best merit so far."""


def optimise(
    recipe: Recipe,
    merit: Merit,
    wavelength: ArrayLike,
    *,
    draws: int = 1000,
    starts: int = 3,
    rounds: int = 6,
    seed: int = 0,
    progress: Progress | None = None,
) -> Search:
    """Search for the filter array of a recipe with the least figure of merit.

    Arrays are drawn at random; from the best of them the search goes downhill, in rounds: first
    masks are exchanged, one filter at a time, for the best of many others, then all thicknesses
    are refined together along the gradient of the transfer matrix.

    Parameters
    ----------
    recipe : Recipe
        Such as ``StencilRecipe()``.
    merit : callable
        From transmittances at normal incidence, (..., M, K), to what shall be least, (...), such as
        ``lambda t: expected_error(t * efficiency, prior, noise=WhiteNoise(20))``.
    wavelength : (K,)
        nm.
    draws : int
        Arrays drawn at random, N.
    starts : int
        How many of them, the best ones, are improved.
    rounds : int
        Rounds for each; a round that gains less than a thousandth is the last. 0 only draws.
    seed : int
        The same seed gives the same array.
    progress : callable, optional
        Called after every step; see `Progress`.

    Raises
    ------
    InputError
        If nothing is to be drawn.

    Source: the gradient search is L-BFGS-B, Byrd et al., SIAM J. Sci. Comput. 16, 1190 (1995).
    """
    if draws < 1 or not 1 <= starts <= draws or rounds < 0:
        raise InputError(
            f"{draws} draws, {starts} starts and {rounds} rounds are no search; draw at least one "
            "array, and improve at most as many as are drawn."
        )
    wavelength = np.asarray(wavelength, float)
    generator = torch.Generator().manual_seed(seed)
    arrays, drawn, history = [], [], []
    best = np.inf

    def note(stage: str, done: int, of: int, found: float) -> None:
        nonlocal best
        best = min(best, found)
        history.append(Step(stage, best))
        if progress is not None:
            progress(stage, done, of, best)

    for first in range(0, draws, BATCH):
        few = [recipe.draw(generator) for _ in range(min(BATCH, draws - first))]
        arrays += few
        drawn.append(merit(together(few).transmittance(wavelength)).detach())
        for done, value in enumerate(drawn[-1].tolist(), first + 1):
            note("draw", done, draws, value)
    drawn = torch.cat(drawn)

    chosen = drawn.argsort()[:starts].tolist()
    found = []
    for start, draw in enumerate(chosen):
        array, value = arrays[draw], float(drawn[draw])
        for turn in range(rounds):
            before = value
            array = exchange(recipe, array, merit, wavelength, generator)
            array, value = refine(recipe, array, merit, wavelength)
            note("improve", start * rounds + turn + 1, starts * rounds, value)
            if value > 0.999 * before:
                break
        found.append((value, array))
    value, array = min(found, key=lambda pair: pair[0])
    return Search(array, value, arrays[chosen[0]], drawn, history)


def together(arrays: list[FilterArray]) -> FilterArray:
    """Return arrays of the same materials as one, (N, M, L)."""
    thickness = torch.stack([torch.atleast_2d(array.thickness) for array in arrays])
    return replace(
        arrays[0], thickness=thickness, layers=torch.stack([array.layers for array in arrays])
    )


def exchange(
    recipe: Recipe,
    array: FilterArray,
    merit: Merit,
    wavelength: np.ndarray,
    generator: Generator,
    times: int = 25,
) -> FilterArray:
    """Return the array with masks exchanged, each time the one that gains most of many tried.

    times : exchanges at most; none where the recipe has no masks to choose from.
    """
    filters = len(array.layers)
    layers = array.layers.clone()
    response = array.transmittance(wavelength)
    value = merit(response)
    for _ in range(times):
        masks = recipe.masks(CANDIDATES, generator)
        if masks is None:
            return array
        fresh = (masks[:, None] != layers).any(-1).all(-1)  # no other filter is made so
        masks = masks[fresh]
        if not len(masks):
            break
        which = torch.randint(filters, (len(masks),), generator=generator)
        tried = response.repeat(len(masks), 1, 1)
        tried[torch.arange(len(masks)), which] = replace(array, layers=masks).transmittance(
            wavelength
        )
        values = merit(tried)
        gain = int(values.argmin())
        if values[gain] < value:
            value, response = values[gain], tried[gain]
            layers[which[gain]] = masks[gain]
    return replace(array, layers=layers)


def refine(
    recipe: Recipe, array: FilterArray, merit: Merit, wavelength: np.ndarray, steps: int = 200
) -> tuple[FilterArray, float]:
    """Return the array at the nearest minimum over its thicknesses, and its merit.

    steps : of the search at most.
    """
    from scipy.optimize import minimize

    least, most = (limit.expand(array.thickness.shape) for limit in recipe.limits)

    def slope(place: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the merit and its gradient, both over `scale`; places are 0..1 within limits."""
        within = torch.from_numpy(place).reshape(least.shape).requires_grad_()
        made = replace(array, thickness=least + (most - least) * within)
        value = merit(made.transmittance(wavelength)) / scale
        (gradient,) = torch.autograd.grad(value, within)
        return value.item(), gradient.numpy().ravel()

    start = ((array.thickness - least) / (most - least)).numpy().ravel()
    scale = 1.0
    # Where all variables have bounds, L-BFGS-B first steps as far as the gradient is long.
    scale = 10 * float(np.linalg.norm(slope(start)[1])) or 1.0
    found = minimize(
        slope,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(0, 1)] * len(start),
        options={"maxiter": steps, "maxcor": 20, "ftol": 1e-7, "gtol": 1e-7},
    )
    thickness = least + (most - least) * torch.from_numpy(found.x).reshape(least.shape)
    return replace(array, thickness=thickness), scale * float(found.fun)
