"""How far a reconstructed cube is from the truth."""

import numpy as np
from numpy.typing import ArrayLike
from xarray import DataArray

from squilla.errors import InputError
from squilla.spectra import resample

DARKEST = 0.01
"""Pixels whose true spectrum stays below this part of the scene's maximum are not judged."""

_BLOCK = 4096  # spectra at a time: their numbers stay in the processor's cache
_WINDOW = 7  # px, of the structural similarity


# --- one number a spectrum: (..., K) and (..., K) give (...) ------------------------------------


def mse(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Return the mean squared error over the bands."""
    return np.square(np.subtract(estimate, truth)).mean(-1)


def rmse(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Return the root of the mean squared error over the bands, in the units of the spectra."""
    return np.sqrt(mse(estimate, truth))


def mae(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Return the mean absolute error over the bands, in the units of the spectra."""
    return np.abs(np.subtract(estimate, truth)).mean(-1)


def psnr(estimate: ArrayLike, truth: ArrayLike, peak: float = 1.0) -> np.ndarray:
    """Return the peak signal-to-noise ratio over the bands, dB, for signals that reach `peak`."""
    with np.errstate(divide="ignore"):  # no error at all is an infinite ratio
        return 10 * np.log10(peak**2 / mse(estimate, truth))


def gfc(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Return the goodness of fit coefficient, 0..1: the correlation of two spectra, whatever scale.

    Above 0.999 a match is called good, above 0.9999 excellent. A spectrum of zeros matches nothing.

    Source: Hernandez-Andres, Romero, Lee, JOSA A 18, 1325 (2001).
    """
    return np.abs(_cosine(estimate, truth))


def sam(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    """Return the spectral angle, rad, 0..pi; a spectrum of zeros is at a right angle to all.

    Source: Kruse et al., Remote Sensing of Environment 44, 145 (1993).
    """
    return np.arccos(np.clip(_cosine(estimate, truth), -1, 1))


def _cosine(estimate: ArrayLike, truth: ArrayLike) -> np.ndarray:
    # In double precision: the arc cosine near 1 would make 1e-7 an angle of 0.03 degrees.
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    pairs = ((estimate, truth), (estimate, estimate), (truth, truth))
    dot, *squares = (np.einsum("...k,...k->...", a, b) for a, b in pairs)
    norm = np.sqrt(squares[0] * squares[1])
    return np.divide(dot, norm, out=np.zeros(np.shape(dot)), where=norm > 0)


# --- pictures -----------------------------------------------------------------------------------


def ssim(estimate: ArrayLike, truth: ArrayLike, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the mean structural similarity of each band, 1 for equal pictures.

    Uniform windows of 7 x 7 px, sample covariance, K1 = 0.01, K2 = 0.03; the range of a band is
    its maximum in the truth, so that dim bands are judged as strictly as bright ones.

    Parameters
    ----------
    estimate, truth : array, (H, W, K)
    mask : array, (H, W), bool, optional
        Centres of the windows that count.

    Returns
    -------
    array, (K,)
        NaN where the truth has no light.

    Raises
    ------
    InputError
        If the picture is smaller than a window.

    Source: Wang et al., IEEE Transactions on Image Processing 13, 600 (2004).
    """
    estimate, truth = np.asarray(estimate), np.asarray(truth)
    if estimate.ndim != 3 or min(estimate.shape[:2]) < _WINDOW:
        raise InputError(
            f"Structural similarity needs cubes of {_WINDOW} x {_WINDOW} px and more, not "
            f"{estimate.shape}."
        )
    edge = _WINDOW // 2
    inside = np.ones(truth.shape[:2], bool) if mask is None else np.asarray(mask, bool)
    inside = inside[edge:-edge, edge:-edge]
    sample = _WINDOW**2 / (_WINDOW**2 - 1)
    c1, c2 = 0.01**2, 0.03**2
    result = np.full(truth.shape[-1], np.nan)
    # Bands first: a picture whose pixels lie apart in memory costs more to fetch than to judge.
    pictures = (np.ascontiguousarray(np.moveaxis(each, -1, 0)) for each in (estimate, truth))
    for band, (x, y) in enumerate(zip(*pictures, strict=True)):
        peak = float(y.max())
        if not peak > 0:
            continue
        x, y = x / np.float64(peak), y / np.float64(peak)
        mean_x, mean_y = _window_mean(x), _window_mean(y)
        product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
        covariance = sample * (_window_mean(x * y) - product)
        variance = sample * (_window_mean(x * x + y * y) - squares)
        similar = (2 * product + c1) * (2 * covariance + c2)
        similar /= (squares + c1) * (variance + c2)
        result[band] = similar.mean(where=inside)
    return result


def _window_mean(picture: np.ndarray) -> np.ndarray:
    """Return the means of all windows that lie whole in a picture."""
    for _ in range(2):  # along the rows, then, turned, along the columns
        two = picture[:-1] + picture[1:]
        four = two[:-2] + two[2:]
        picture = (four[:-3] + two[4:-1] + picture[6:]).T
    return picture / _WINDOW**2


def ciede2000(
    estimate: np.ndarray, truth: np.ndarray, wavelength: np.ndarray, light: np.ndarray
) -> np.ndarray:
    """Return the colour difference that the CIE 1931 observer sees between two cubes.

    About 1 is just noticeable. Light outside the band is left out on both sides, so metamers that
    differ only there count as equal.

    Parameters
    ----------
    estimate, truth : array, (..., K)
        Photon radiance, in the unit of `light`.
    wavelength : array, (K,)
        nm, increasing.
    light : array, (K,)
        Photon radiance of a white surface in the scene.

    Returns
    -------
    array, (...)

    Source: CIE 142-2001, through colour-science.
    """
    import colour

    from squilla.colour import tristimulus

    white = tristimulus(light, wavelength)
    lab = [
        colour.XYZ_to_Lab(tristimulus(each, wavelength) / white[1], colour.XYZ_to_xy(white))
        for each in (estimate, truth)
    ]
    return np.asarray(colour.delta_E(*lab, method="CIE 2000"))


# --- the summary --------------------------------------------------------------------------------


def evaluate(
    cube: DataArray | np.ndarray,
    reference: DataArray | np.ndarray,
    *,
    mask: np.ndarray | None = None,
) -> dict[str, float]:
    """Judge a cube, or a list of spectra, against the truth.

    As in the thesis, each spectrum and its truth are divided by the maximum of the truth, so that
    dim pixels weigh as much as bright ones. Pixels whose truth stays below 1 % of the scene's
    maximum, pixels outside `mask` and pixels with NaN in either cube are left out and counted.

    Parameters
    ----------
    cube, reference : DataArray or array, (..., K)
        In one unit. Where both are DataArrays the reference is brought onto the wavelengths, and
        into the order of dimensions, of the cube.
    mask : array, (...), bool, optional
        Pixels that count.

    Returns
    -------
    dict
        mse, rmse, mae : mean over pixels and bands, 1 being the maximum of each true spectrum;
        mse_median : the median over pixels instead, which few dark ones beside bright ones leave;
        psnr_db : of the radiance itself, with the scene's maximum as peak;
        sam_deg, gfc : means over the pixels;
        ssim : mean over the bands; NaN for lists of spectra and pictures below 7 px;
        pixels, left_out : how many were judged, how many not.

    Raises
    ------
    InputError
        If the shapes or wavelengths do not fit, or no pixel is left.

    Source: thesis, table 5.1, for the scale of the squared error.
    """
    estimate, truth = _paired(cube, reference)
    peak = truth.max(-1)
    keep = np.isfinite(peak) & np.isfinite(estimate.sum(-1)) & np.isfinite(truth.sum(-1))
    brightest = peak[keep].max(initial=0)
    keep &= peak >= max(DARKEST * brightest, np.finfo(np.float32).tiny)
    if mask is not None:
        if np.shape(mask) != peak.shape:
            raise InputError(f"The mask is {np.shape(mask)}, but the cube has {peak.shape} pixels.")
        keep &= np.asarray(mask, bool)
    if not keep.any():
        raise InputError("No pixel is left to be judged: all are dark, NaN or masked.")
    place = np.flatnonzero(keep)
    flat = [each.reshape(-1, each.shape[-1]) for each in (estimate, truth)]
    rows = []
    for start in range(0, len(place), _BLOCK):
        some = place[start : start + _BLOCK]
        scale = peak.ravel()[some].astype(np.float64)
        x, y = (each[some] / scale[:, None] for each in flat)
        error, cosine = mse(x, y), _cosine(x, y)
        angle = np.arccos(np.clip(cosine, -1, 1))
        rows.append([error, mae(x, y), error * scale**2, angle, np.abs(cosine)])
    every = np.concatenate(rows, -1)
    error, absolute, raw, angle, similar = every.mean(-1)
    similarity = np.nan
    if truth.ndim == 3 and min(truth.shape[:2]) >= _WINDOW:
        seen, true = (np.where(keep[..., None], each, 0) for each in (estimate, truth))
        similarity = np.nanmean(ssim(seen, true, keep))
    with np.errstate(divide="ignore"):
        ratio = 10 * np.log10(float(brightest) ** 2 / raw)
    return {
        "mse": float(error),
        "mse_median": float(np.median(every[0])),
        "rmse": float(np.sqrt(error)),
        "mae": float(absolute),
        "psnr_db": float(ratio),
        "sam_deg": float(np.degrees(angle)),
        "gfc": float(similar),
        "ssim": float(similarity),
        "pixels": len(place),
        "left_out": peak.size - len(place),
    }


def _paired(
    cube: DataArray | np.ndarray, reference: DataArray | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and truth as arrays of one shape, on the wavelengths of the estimate."""
    for each in (cube, reference):
        if isinstance(each, DataArray) and "wavelength" not in each.dims:
            raise InputError(f'A cube has a dimension "wavelength"; this one has {each.dims}.')
    if (
        isinstance(cube, DataArray)
        and isinstance(reference, DataArray)
        and set(cube.dims) == set(reference.dims)
    ):
        reference = reference.transpose(*cube.dims)
    estimate, truth = (
        np.asarray(each.transpose(..., "wavelength") if isinstance(each, DataArray) else each)
        for each in (cube, reference)
    )
    if all("wavelength" in getattr(each, "coords", ()) for each in (cube, reference)):
        here, there = (np.asarray(each["wavelength"], float) for each in (cube, reference))
        if len(here) != len(there) or not np.allclose(here, there, rtol=0, atol=1e-6):
            truth = resample(truth, there, here)
    if estimate.shape != truth.shape:
        raise InputError(f"The cube is {estimate.shape}, but its reference is {truth.shape}.")
    return estimate, truth
