import numpy as np
import pytest
import torch
from tmm import coh_tmm

from squilla.errors import InputError
from squilla.optics.thinfilm import reflectance, transmittance

WAVELENGTH = np.array([480.0, 550.0, 633.0, 790.0])


def random_stack(seed, *, absorbing=True, layers=7):
    rng = np.random.default_rng(seed)
    index = rng.uniform(1.3, 2.6, (layers, len(WAVELENGTH))).astype(complex)
    substrate = rng.uniform(1.4, 3.5, len(WAVELENGTH)).astype(complex)
    if absorbing:
        index += 1j * rng.choice([0, 0.002, 0.3], index.shape)
        substrate += 1j * rng.choice([0, 0.5, 2.0], substrate.shape)
    return index, rng.uniform(0, 300, (3, layers)), substrate


@pytest.mark.parametrize("polarization", ["s", "p"])
@pytest.mark.parametrize("degrees", [0, 7, 30, 60])
@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_tmm(seed, degrees, polarization):
    index, thickness, substrate = random_stack(seed)
    given = {"substrate": substrate, "angle": np.deg2rad(degrees), "polarization": polarization}
    expected = [
        [
            coh_tmm(polarization, [1, *n, back], [np.inf, *stack, np.inf], given["angle"], lam)
            for n, back, lam in zip(index.T, substrate, WAVELENGTH, strict=True)
        ]
        for stack in thickness
    ]
    for ours, letter in ((transmittance, "T"), (reflectance, "R")):
        result = ours(index, thickness, WAVELENGTH, **given)
        theirs = [[solution[letter] for solution in row] for row in expected]
        np.testing.assert_allclose(result, theirs, rtol=0, atol=1e-11)


@pytest.mark.parametrize("ambient", [1.0, 1.52, 2.0])
def test_energy_is_conserved_without_absorption(ambient):
    """Also beyond the critical angle, where the light tunnels or is totally reflected."""
    index, thickness, substrate = random_stack(5, absorbing=False)
    given = {"substrate": substrate, "ambient": ambient, "angle": np.deg2rad([0, 40, 65, 89])}
    for polarization in ("s", "p", "unpolarized"):
        through = transmittance(index, thickness, WAVELENGTH, polarization=polarization, **given)
        back = reflectance(index, thickness, WAVELENGTH, polarization=polarization, **given)
        torch.testing.assert_close(through + back, torch.ones_like(back), rtol=0, atol=1e-12)


def test_absorption_takes_energy():
    index, thickness, substrate = random_stack(5)
    index = index + 0.01j
    total = transmittance(index, thickness, WAVELENGTH, substrate=substrate)
    total += reflectance(index, thickness, WAVELENGTH, substrate=substrate)
    assert (total < 1).all()


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_reciprocity(polarization):
    """A stack, absorbing or not, transmits as much backwards, at the refracted angle."""
    index, thickness, _ = random_stack(6)
    angle, glass = 0.7, 1.52
    there = transmittance(
        index, thickness, WAVELENGTH, substrate=glass, angle=angle, polarization=polarization
    )
    back = transmittance(
        index[::-1].copy(), thickness[:, ::-1].copy(), WAVELENGTH, substrate=1.0, ambient=glass,
        angle=np.arcsin(np.sin(angle) / glass), polarization=polarization,
    )  # fmt: skip
    torch.testing.assert_close(there, back, rtol=0, atol=1e-12)


def test_bare_interface_is_fresnels():
    angle, n = 1.1, 1.7
    refracted = np.arcsin(np.sin(angle) / n)
    s = (np.sin(angle - refracted) / np.sin(angle + refracted)) ** 2
    p = (np.tan(angle - refracted) / np.tan(angle + refracted)) ** 2
    for polarization, expected in (("s", s), ("p", p), ("unpolarized", (s + p) / 2)):
        result = reflectance([], [], [600.0], substrate=n, angle=angle, polarization=polarization)
        assert result.item() == pytest.approx(expected, abs=1e-14)


def test_no_p_reflection_at_brewsters_angle():
    result = reflectance([], [], [600.0], substrate=1.5, angle=np.arctan(1.5), polarization="p")
    assert result.item() < 1e-30


@pytest.mark.parametrize("pairs", [0, 1, 4, 10])
def test_quarter_wave_mirror(pairs):
    """R = ((n_0 - Y) / (n_0 + Y))^2 with the admittance Y = (n_H / n_L)^(2 pairs) n_substrate."""
    high, low, glass = 2.35, 1.46, 1.52
    index = [high, low] * pairs
    admittance = (high / low) ** (2 * pairs) * glass
    expected = ((1 - admittance) / (1 + admittance)) ** 2
    result = reflectance(index, [550 / 4 / n for n in index], [550.0], substrate=glass)
    assert result.item() == pytest.approx(expected, abs=1e-12)


def test_half_wave_layer_is_absent():
    bare = transmittance([], [], [550.0], substrate=1.52)
    coated = transmittance([2.35], [550 / 2 / 2.35], [550.0], substrate=1.52)
    torch.testing.assert_close(coated, bare)


def test_layers_without_thickness_change_nothing_at_all():
    index, thickness, substrate = random_stack(7)
    thickness[:, [1, 4]] = 0
    keep = [0, 2, 3, 5, 6]
    given = {"substrate": substrate, "angle": [0.0, 0.6]}
    with_them = transmittance(index, thickness, WAVELENGTH, **given)
    without = transmittance(index[keep], thickness[:, keep], WAVELENGTH, **given)
    torch.testing.assert_close(with_them, without, rtol=0, atol=1e-14)


def test_layers_that_a_stack_lacks():
    """Stacks that share thicknesses and lack layers are those built one by one."""
    index, thickness, substrate = random_stack(11)
    layers = np.random.default_rng(0).random((5, 1, 7)) < 0.6
    given = {"substrate": substrate, "angle": [0.0, 0.6]}
    for function in (transmittance, reflectance):
        shared = function(index, thickness, WAVELENGTH, layers=layers, **given)
        assert shared.shape == (5, 3, 2, len(WAVELENGTH))
        for m, row in enumerate(layers[:, 0]):
            alone = function(index[row], thickness[:, row], WAVELENGTH, **given)
            torch.testing.assert_close(shared[m], alone, rtol=0, atol=1e-13)


def test_opaque_metal_neither_overflows_nor_transmits():
    metal = 0.05 + 4j
    result = transmittance([metal, 1.5], [1e6, 100.0], [600.0], substrate=1.5)
    assert result.item() == 0
    back = reflectance([metal, 1.5], [1e6, 100.0], [600.0], substrate=1.5)
    assert back.item() == pytest.approx(abs((1 - metal) / (1 + metal)) ** 2)


def test_shapes_broadcast_stack_by_stack_and_angle_by_angle():
    index, thickness, substrate = random_stack(8)
    batch = torch.from_numpy(np.stack([thickness, thickness[::-1]]))  # (2, 3, L)
    angle = [0.0, 0.3, 0.9]
    own_index = np.broadcast_to(index, (2, 3, *index.shape)).copy()
    together = transmittance(own_index, batch, WAVELENGTH, substrate=substrate, angle=angle)
    assert together.shape == (2, 3, 3, len(WAVELENGTH))
    for i in range(2):
        for j in range(3):
            for a in range(3):
                alone = transmittance(
                    index, batch[i, j], WAVELENGTH, substrate=substrate, angle=angle[a]
                )
                assert alone.shape == (len(WAVELENGTH),)
                torch.testing.assert_close(together[i, j, a], alone)
    shared = transmittance(index, batch, WAVELENGTH, substrate=substrate, angle=angle)
    torch.testing.assert_close(together, shared)


def test_constant_index_needs_no_table():
    one = transmittance([2.3, 1.46], [80.0, 120.0], WAVELENGTH, substrate=1.52)
    table = np.repeat([[2.3], [1.46]], len(WAVELENGTH), 1)
    glass = np.full(len(WAVELENGTH), 1.52)
    torch.testing.assert_close(
        one, transmittance(table, [80.0, 120.0], WAVELENGTH, substrate=glass)
    )
    assert transmittance([], [], WAVELENGTH, substrate=1.52).shape == WAVELENGTH.shape
    assert reflectance([], [], WAVELENGTH, substrate=1.52).shape == WAVELENGTH.shape


@pytest.mark.parametrize("function", [transmittance, reflectance])
@pytest.mark.parametrize("polarization", ["s", "p", "unpolarized"])
def test_gradient(function, polarization):
    index, thickness, substrate = random_stack(9, layers=4)
    thickness = torch.from_numpy(thickness).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda d: function(
            index, d, WAVELENGTH, substrate=substrate, angle=[0.0, 0.8], polarization=polarization
        ),
        thickness,
    )


def test_gradient_of_a_layer_that_is_just_being_born():
    index, thickness, substrate = random_stack(10)
    thickness[:, 3] = 0
    bare = torch.from_numpy(thickness).requires_grad_()
    before = transmittance(index, bare, WAVELENGTH, substrate=substrate).sum()
    before.backward()
    thickness[:, 3] = 1e-5
    after = transmittance(index, thickness, WAVELENGTH, substrate=substrate).sum()
    assert bare.grad is not None
    assert bare.grad[:, 3].sum().item() == pytest.approx((after - before).item() / 1e-5, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness": [100.0]}, "do not fit"),
        ({"thickness": [100.0, -1.0]}, "negative or undefined thickness"),
        ({"thickness": [100.0, float("nan")]}, "negative or undefined thickness"),
        ({"index": [2.0 - 0.1j, 1.5]}, "amplify"),
        ({"index": np.ones((2, 3))}, "3 wavelengths, not 2"),
        ({"angle": 45}, "rad"),
        ({"polarization": "TE"}, "TE"),
        ({"ambient": 1 + 0.1j}, "real and positive"),
        ({"wavelength": [0.0, 500.0]}, "positive"),
        ({"layers": [True, False, True]}, "said for 3"),
    ],
)
def test_bad_input(change, message):
    given = {
        "index": [2.0, 1.5], "thickness": [100.0, 50.0], "wavelength": [500.0, 600.0],
        "substrate": 1.5,
    } | change  # fmt: skip
    with pytest.raises(InputError, match=message):
        transmittance(**given)
