"""Arrays of which everything is known: pictures are formulas, so units see them without error."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from typer.testing import CliRunner

from conftest import small_design
from squilla import align_stack
from squilla.calibration.alignment import align, measure, place
from squilla.calibration.bundle import lattice_from_shots
from squilla.calibration.calibration import Lattice
from squilla.calibration.disparity import find_plane, fit_plane, plane_map
from squilla.calibration.edges import find_edges
from squilla.calibration.geometry import find_windows
from squilla.calibration.quality import colour_error, drift, misalignment
from squilla.calibration.resample import monomials
from squilla.calibration.stack import agreement
from squilla.calibration.views import SubImages
from squilla.camera.twin import Camera
from squilla.cli.app import app
from squilla.errors import InputError

MARGIN = 24


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def waves(seed: int = 0, count: int = 24):
    """Return a picture as a formula of position: plane waves of 6 to 40 px."""
    random = np.random.default_rng(seed)
    angle, length = random.uniform(0, 2 * np.pi, count), random.uniform(6, 40, count)
    vector = 2 * np.pi / length * np.stack([np.sin(angle), np.cos(angle)])
    phase, height = random.uniform(0, 2 * np.pi, count), length / 40

    def picture(y, x):
        total = np.zeros(np.broadcast(y, x).shape)
        for (v, u), p, h in zip(vector.T, phase, height, strict=True):
            total += h * np.cos(v * y + u * x + p)
        return total / np.sqrt(np.sum(height**2) / 2)

    return picture


def array(rows: int = 4, columns: int = 4, size: int = 140, spread: float = 0.0) -> Lattice:
    random = np.random.default_rng(11)
    place = np.stack(np.mgrid[:rows, :columns], -1).reshape(-1, 2).astype(float)
    reference = (rows // 2) * columns + columns // 2
    centre = 110 + 210 * place + spread * random.standard_normal(place.shape)
    baseline = (centre - centre[reference]) / 210
    return Lattice(
        (rows, columns), centre, baseline, reference, (size, size), 600.0, 210.0, 3.0, 300
    )


def seen(lattice: Lattice, plane, pictures, mixture, pixel):
    """Return what each unit shows at sensor positions `pixel`, a list of (2, h, w) by unit."""
    half = (np.array(lattice.field) - 1)[:, None, None] / 2
    images = []
    for unit, at in enumerate(pixel):
        target = at - lattice.centre[unit][:, None, None]
        point = target
        for _ in range(8):
            y, x = point / half
            shift = (plane[0] + plane[1] * y + plane[2] * x) * lattice.baseline[unit][:, None, None]
            if lattice.bend is not None:
                powers = [y**i * x**j for i, j in ORDERS]
                shift = shift + np.tensordot(lattice.bend[unit], np.stack(powers), 1)
            point = target - shift
        views = np.stack([picture(*point) for picture in pictures])
        images.append(2 + np.tensordot(mixture[unit], views, 1))
    return np.array(images)


ORDERS = [(1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]


def capture(lattice: Lattice, plane, *, noise=0.0, colours=2, seed=0) -> SubImages:
    """Return the windows of an array before a plane, each unit mixing a few pictures its way."""
    random = np.random.default_rng(seed)
    mixture = random.normal(0.3, 0.4, (len(lattice.centre), colours))  # some are negatives
    mixture *= 0.5 ** np.arange(colours)
    half = (np.array(lattice.field) - 1) / 2
    origin = np.floor(lattice.centre - half).astype(int) - MARGIN
    grid = np.mgrid[: lattice.field[0] + 2 * MARGIN, : lattice.field[1] + 2 * MARGIN]
    pixel = [grid + corner[:, None, None] for corner in origin]
    images = seen(lattice, plane, [waves(k) for k in range(colours)], mixture, pixel)
    images = images + noise * random.standard_normal(images.shape)
    offset = lattice.centre - origin - half - MARGIN
    bad = torch.zeros(images.shape, dtype=torch.bool)
    return SubImages(torch.from_numpy(images.astype(np.float32)), bad, offset, MARGIN, 0.0)


def found_in(views: SubImages, lattice: Lattice, **options):
    edges = find_edges(views.image.numpy(), views.bad.numpy(), options.pop("noise", None))
    return find_plane(edges, lattice, views.margin + views.offset, (0.0, 8.0), **options)


def shift_error(lattice: Lattice, found, plane) -> float:
    error = (plane_map(found.plane - plane, lattice))[..., None, None] * lattice.baseline
    error = error + found.offset
    return rms(error - error.mean(2, keepdims=True))


@pytest.mark.parametrize(
    ("step", "noise", "smooth"), [(2, None, 2), (4, None, 4), (2, 0.2, 4), (2, 1.0, 8)]
)
def test_edges_are_the_slopes_of_the_smoothed_picture(step, noise, smooth):
    """However small the picture was made on the way, and wherever its points lie then."""
    picture = ndimage.gaussian_filter(np.random.default_rng(4).standard_normal((260, 301)), 3)
    picture /= picture.std()
    edges = find_edges(
        picture[None].astype(np.float32),
        noise=None if noise is None else np.array([noise]),
        step=step,
    )
    assert edges.smooth == smooth
    place = np.mgrid[: edges.bad.shape[1], : edges.bad.shape[2]] * edges.step + edges.corner
    slopes = [ndimage.gaussian_filter(picture, smooth, order) for order in ((0, 1), (1, 0))]
    expected = np.stack([ndimage.map_coordinates(slope, place) for slope in slopes])
    good = ~edges.bad[0]
    assert good.mean() > 0.5
    expected = expected[:, good] / np.sqrt(np.mean(np.sum(expected[:, good] ** 2, 0)))
    assert rms(edges.values[:, 0, good] - expected) < 0.02


@pytest.mark.parametrize("plane", [(3.0, 0.0, 0.0), (6.5, 0.25, -0.3), (0.4, -0.02, 0.03)])
def test_a_tilted_plane_is_found(plane):
    lattice = array(spread=2.0)
    found = found_in(capture(lattice, plane), lattice)
    assert shift_error(lattice, found, np.array(plane)) < 0.01
    assert found.score > 0.2


def test_noise_costs_what_is_stated():
    """Over several noises the error is what the covariance says, within a factor of two."""
    lattice, plane = array(), np.array([4.0, 0.1, -0.1])
    errors, stated = [], []
    for seed in range(6):
        views = capture(lattice, plane, noise=0.3, colours=1, seed=seed)
        found = found_in(views, lattice, noise=np.full(16, 0.09))
        errors.append(found.plane - plane)
        stated.append(np.diag(found.covariance))
    ratio = np.mean(np.square(errors)) / np.mean(stated)
    assert 0.25 < ratio < 4


def test_the_frame_before_spares_the_search():
    lattice, plane = array(), np.array([4.0, 0.1, -0.1])
    views = capture(lattice, plane)
    cold = found_in(views, lattice)
    warm = found_in(views, lattice, start=plane + np.array([0.4, -0.05, 0.02]))
    np.testing.assert_allclose(warm.plane, cold.plane, atol=0.004)


@pytest.mark.parametrize("distance", [90.0, 290.0, 1000.0])
def test_a_scene_that_jumped_is_found(camera, calibration, scene, distance):
    """The frame before may help, but never decides: wherever it lay, the same is found."""
    raw = camera.capture(
        scene, distance=distance, snr=30, generator=torch.Generator().manual_seed(3)
    )
    cold = measure(raw, calibration)
    for before in (0.0, 0.2, 0.6, 1.2, 2.1, 4.0):
        start = replace(cold, disparity=torch.full_like(cold.disparity, before))
        warm = measure(raw, calibration, start=start)
        assert warm.provenance["alignment"] == "from the scene"
        assert (warm.disparity - cold.disparity).abs().max() < 0.02


def test_a_given_distance_counts_more_than_the_frame_before(camera, calibration, scene):
    """The field must reach as far as the distance asks, wherever the frame before was."""
    raw = camera.capture(scene, distance=90, snr=30, generator=torch.Generator().manual_seed(1))
    start = measure(raw, calibration, distance=1000)
    found = measure(raw, calibration, distance=90, start=start)
    expected = measure(raw, calibration, distance=90)
    assert torch.equal(found.valid, expected.valid)
    torch.testing.assert_close(found.y, expected.y, equal_nan=True)


def test_units_beside_their_places_are_found():
    lattice, plane = array(), np.array([3.0, 0.05, 0.1])
    views = capture(lattice, plane, colours=1)
    beside = np.random.default_rng(2).normal(0, 0.4, (16, 2))
    thought = replace(views, offset=views.offset - beside)
    assert drift(found_in(thought, lattice), lattice) > 0.1
    found = found_in(thought, lattice, free=0.5)
    assert np.abs(np.sum(found.offset * lattice.baseline)) < 1e-3  # that would be disparity
    position = found.offset + found.plane[0] * lattice.baseline
    error = position - beside - plane[0] * lattice.baseline
    assert rms(error - error.mean(0)) < 0.02


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("seed", [2, 3])
def test_a_lattice_that_moved_is_told_and_followed(colours, seed):
    lattice = array(5, 5, 110)
    views = capture(lattice, (3.0, 0.0, 0.0), colours=colours, noise=0.03)
    beside = np.random.default_rng(seed).normal(0, 0.3, (25, 2))
    thought = replace(views, offset=views.offset - beside)
    _, offset, quality = place(thought, lattice, 8.0, refine=False)
    assert not offset.any()
    assert 0.15 < quality["lattice_moved"] < 0.5
    _, offset, _ = place(thought, lattice, 8.0)
    assert rms(offset) > 0.1
    _, offset, quality = place(views, lattice, 8.0)
    assert quality["lattice_moved"] < 0.02
    assert not offset.any()


@pytest.mark.parametrize("kind", ["turned", "shifted", "stretched"])
def test_of_whole_arrays_only_a_turn_is_seen(kind):
    """A shift moves the picture, a stretch its distance; across baselines neither moves a thing."""
    lattice, plane = array(), (3.0, 0.0, 0.0)
    from_middle = lattice.centre - lattice.centre.mean(0)
    from_middle = 0.3 * from_middle / rms(from_middle)
    beside = {
        "turned": from_middle @ [[0, -1], [1, 0]],
        "shifted": np.full_like(lattice.centre, 0.3),
        "stretched": from_middle,
    }[kind]
    views = capture(lattice, plane, colours=1)
    thought = replace(views, offset=views.offset - beside)
    found, _, quality = place(thought, lattice, 8.0, refine=False)
    if kind == "turned":
        # Half of the turn about the middle is the reference's own, a shift of everything.
        assert quality["lattice_moved"] > 0.2
    else:
        assert quality["lattice_moved"] < 0.02
    step = from_middle[1, 1] - from_middle[0, 1]  # by which the stretch moves neighbours apart
    expected = 3.0 + (step if kind == "stretched" else 0)
    assert found[0] == pytest.approx(expected, abs=0.02)


def test_depth_is_not_taken_for_a_lattice_that_moved():
    """The middle stands nearer: the parts disagree, but nothing lies across baselines."""
    lattice = array()
    far, near = (capture(lattice, (d, 0.0, 0.0), colours=1) for d in (3.0, 3.5))
    both = far.image.clone()
    middle = slice(MARGIN + 50, MARGIN + 90)
    both[:, :, middle] = near.image[:, :, middle]
    found = found_in(replace(far, image=both), lattice)
    assert drift(found, lattice) < 0.1
    assert found.relief[:, 2].mean() > 0.1
    assert found.relief[:, [0, 4]].mean() < -0.1
    assert misalignment(found, lattice) > 0.1


def test_bent_views_are_straightened():
    lattice = array(spread=1.0)
    lattice = replace(lattice, bend=np.random.default_rng(1).normal(0, 0.3, (16, 2, 9)))
    plane = np.array([3.0, 0.2, -0.1])
    views = capture(lattice, plane, colours=1)
    y, valid = align(views, lattice, plane_map(plane, lattice))
    half = (np.array(lattice.field) - 1) / 2
    grid = np.mgrid[: lattice.field[0], : lattice.field[1]] - half[:, None, None]
    mixture = np.random.default_rng(0).normal(0.3, 0.4, (16, 1))
    expected = 2 + waves(0)(*grid)[..., None] * mixture[:, 0]
    np.testing.assert_allclose(y.numpy(), expected, atol=0.01)
    assert valid.all()


def test_what_no_unit_shows_is_not_valid():
    lattice = array()
    views = capture(lattice, (0.0, 0.0, 0.0))
    _, valid = align(views, lattice, 40.0)
    beyond = 40 * lattice.baseline[0, 0] + MARGIN  # rows at which the first unit's window begins
    assert not valid[: int(-beyond), :, 0].any()
    assert valid[..., lattice.reference].all()


def test_a_plane_fits_its_own_map():
    lattice, plane = array(), np.array([3.0, 0.2, -0.1])
    np.testing.assert_allclose(fit_plane(plane_map(plane, lattice)), plane, atol=1e-9)


def test_monomials_are_the_ten_of_degree_three():
    terms = monomials(5, 7)
    y, x = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 7), indexing="ij")
    for term, (i, j) in zip(terms, [(0, 0), *ORDERS], strict=True):
        np.testing.assert_allclose(term, y**i * x**j)


@pytest.mark.parametrize("shift", [0.02, 0.1])
def test_a_misplaced_channel_costs_the_stated_colour(shift):
    y, x = np.mgrid[:120, :120].astype(float)
    pictures = [waves(k) for k in range(4)]
    right = np.stack([2 + 0.4 * p(y, x) for p in pictures], -1)
    signs = np.array([1, -1, 1, -1])
    wrong = np.stack(
        [2 + 0.4 * p(y + s * shift, x - s * shift) for p, s in zip(pictures, signs, strict=True)],
        -1,
    )
    true = np.linalg.norm(wrong - right) / np.linalg.norm(right)
    stated = colour_error(torch.from_numpy(right), np.zeros(4), shift)
    assert stated == pytest.approx(true, rel=0.2)


def test_noise_alone_costs_no_colour():
    """Beside the true slopes those of resampled noise do not count."""
    lattice = array()
    random = np.random.default_rng(0)
    views = capture(lattice, (0.0, 0.0, 0.0))
    noise = torch.from_numpy(random.standard_normal(views.image.shape).astype(np.float32))
    offset = random.uniform(-0.5, 0.5, (16, 2))
    y, _ = align(replace(views, image=10 + noise, offset=offset), lattice, 0.0)
    alone = colour_error(y, np.zeros(16), 1.0)
    assert colour_error(y, np.ones(16), 1.0) < 0.25 * alone


# --- the lattice from shots -------------------------------------------------------------------


def frame(lattice: Lattice, plane) -> np.ndarray:
    """Return a whole frame of a poster, every unit on its tile."""
    size = (210 * lattice.shape[0] + 20, 210 * lattice.shape[1] + 20)
    image = np.zeros(size)
    corner = (
        np.stack(np.mgrid[: lattice.shape[0], : lattice.shape[1]], -1).reshape(-1, 2) * 210 + 10
    )
    pixel = [np.mgrid[:200, :200] + c[:, None, None] for c in corner]
    tiles = seen(lattice, plane, [waves(5)], np.full((len(corner), 1), 0.5), pixel)
    for (row, column), tile in zip(corner, tiles, strict=True):
        image[row : row + 200, column : column + 200] = tile
    return image


@pytest.fixture(scope="module")
def shots():
    lattice = array(3, 3, 140, spread=1.5)
    bend = np.random.default_rng(1).normal(0, 0.2, (9, 2, 9))
    bend[lattice.reference] = 0
    lattice = replace(lattice, bend=bend)
    planes = [np.array(p) for p in ((8.0, 0.2, 0.1), (4.0, -0.1, 0.2), (1.5, 0.05, -0.05))]
    random = np.random.default_rng(0)
    taken = [frame(lattice, p) + 0.005 * random.standard_normal((650, 650)) for p in planes]
    rough = lattice.centre + random.normal(0, 1.0, (9, 2))
    rough -= (rough - lattice.centre).mean(0)
    start = replace(
        lattice, centre=rough, baseline=(rough - rough[lattice.reference]) / 210, bend=None
    )
    return lattice, planes, taken, start


def test_the_lattice_is_learnt_from_shots_nobody_measured(shots):
    truth, planes, taken, start = shots
    lattice, seen_planes = lattice_from_shots(taken, start, nearest=35.0)
    found, right = lattice.centre - lattice.centre.mean(0), truth.centre - truth.centre.mean(0)
    scale = np.sum(found * right) / np.sum(found * found)  # which nothing in the shots tells
    assert abs(scale - 1) < 3e-3
    assert rms(scale * found - right) < 0.03
    # What alignment sees, everything together: where units see the points of each shot.
    terms = monomials(140, 140)[:, ::10, ::10]

    def places(lattice, plane):
        shift = np.tensordot(plane, terms[:3], 1) * lattice.baseline[..., None, None]
        shift = shift + lattice.centre[..., None, None] + np.tensordot(lattice.bend, terms[1:], 1)
        return shift - shift.mean(0)

    for plane, other in zip(planes, seen_planes, strict=True):
        assert rms(places(lattice, other) - places(truth, plane)) < 0.03


def test_one_measured_distance_gives_the_scale(shots):
    truth, planes, taken, start = shots
    distance = truth.distance(planes[1][0])
    lattice, seen_planes = lattice_from_shots(taken, start, distances={1: distance}, nearest=35.0)
    found, right = lattice.centre - lattice.centre.mean(0), truth.centre - truth.centre.mean(0)
    assert rms(found - right) < 0.03
    assert seen_planes[0][0] == pytest.approx(planes[0][0], abs=0.03)


def test_shots_that_tell_nothing_are_refused(shots):
    _, _, taken, start = shots
    with pytest.raises(InputError, match="at least two"):
        lattice_from_shots(taken[:1], start)
    noise = np.random.default_rng(0).standard_normal(taken[0].shape)
    with pytest.raises(InputError, match="shot 1"):
        lattice_from_shots([taken[0], noise], start, nearest=35.0)


# --- stacks of any array ----------------------------------------------------------------------


def stack_of(rows, columns, step, seed=0, size=150):
    """Return views of a plane cut without margins, their grid irregular by half a pixel."""
    random = np.random.default_rng(seed)
    place = np.stack(np.mgrid[:rows, :columns], -1).reshape(-1, 2).astype(float)
    place -= place[(rows // 2) * columns + columns // 2]
    shift = step * place + random.normal(0, 0.5, place.shape)
    y, x = np.mgrid[:size, :size]
    views = [
        2 + random.normal(0.5, 0.2) * waves(0)(y - dy, x - dx)
        + random.normal(0, 0.2) * waves(1)(y - dy, x - dx)
        for dy, dx in shift
    ]  # fmt: skip
    return np.array(views, np.float32)


@pytest.mark.parametrize("shape", [(3, 3), (1, 5), (5, 1), (2, 2)])
@pytest.mark.parametrize("step", [4.3, -6.7])
def test_any_array_is_aligned(shape, step):
    views = stack_of(*shape, step)
    aligned = align_stack(views, shape)
    assert aligned.provenance["disparity"] == pytest.approx(step, abs=0.5)
    all_there = aligned.valid.all(-1)
    assert all_there.float().mean() > 0.5
    y = aligned.y[all_there].numpy().astype(float)
    # Two pictures and a level explain all views, once they lie on each other.
    left = np.linalg.svd(y - y.mean(0), compute_uv=False)
    assert left[2:].max(initial=0) < 0.02 * left[0]


def test_agreement_tells_aligned_from_not():
    views = stack_of(3, 3, 4.3)
    aligned = align_stack(views, (3, 3))
    before = views.transpose(1, 2, 0)
    after = agreement(aligned.y.numpy(), aligned.valid.numpy())
    assert np.median(after) < 0.2 * np.median(agreement(before, np.ones(before.shape, bool)))


def test_missing_pixels_are_not_believed():
    views = stack_of(3, 3, 2.0)
    views[4, 60:80, 60:80] = np.nan
    aligned = align_stack(views, (3, 3))
    assert not aligned.valid[65:75, 65:75, 4].any()
    assert aligned.y.isfinite().all()


@pytest.mark.parametrize(
    ("shape", "cut", "says"),
    [((2, 3), 0, "shape"), ((3, 3), 130, "too small"), ((3, 3), -1, "agree")],
)
def test_stacks_that_are_none_are_refused(shape, cut, says):
    views = stack_of(3, 3, 2.0)
    if cut < 0:
        views = np.random.default_rng(0).standard_normal(views.shape)
    with pytest.raises(InputError, match=says):
        align_stack(views[:, cut if cut > 0 else 0 :], shape)


def test_the_command_aligns_a_file(tmp_path):
    np.save(tmp_path / "views.npy", stack_of(1, 4, 3.0))
    call = ["align", str(tmp_path / "views.npy"), "--shape", "1x4", "--json"]
    result = CliRunner().invoke(app, [*call, "-o", str(tmp_path / "aligned.npy")])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["disparity"] == pytest.approx(3.0, abs=0.5)
    assert np.load(tmp_path / "aligned.npy").shape == (4, 150, 150)
    result = CliRunner().invoke(app, [*call, "-o", str(tmp_path / "aligned.png")])
    assert result.exit_code != 0


@pytest.mark.parametrize("shape", [(1, 4), (4, 1)])
def test_windows_of_a_single_row_are_found(shape):
    design = small_design(
        array={"rows": shape[0], "columns": shape[1], "rotation": 1.0}, field={"reference": 1}
    )
    flat = Camera(design).flat_rate(np.ones(len(design.wavelength)))
    wider = 1 + 2.0 / 33.7
    found = find_windows(flat, shape, design.pitch * wider)
    middle = design.centres.mean(0)
    assert rms(found - (middle + (design.centres - middle) * wider)) < 0.1


def test_a_frame_of_shifted_bits_is_refused(camera, calibration, scene):
    raw = camera.capture(scene, snr=30, generator=torch.Generator().manual_seed(3))
    shifted = replace(raw, frame=raw.frame << 4)
    with pytest.raises(InputError, match="bits were shifted"):
        measure(shifted, calibration)


def test_a_path_is_no_raw_frame(calibration):
    with pytest.raises(InputError, match="made of a raw frame"):
        measure("raw.tiff", calibration)
