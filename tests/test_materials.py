import numpy as np
import pytest

from squilla.errors import InputError
from squilla.optics.materials import materials, refractive_index


def test_every_material_that_ships_can_be_read():
    assert {"TiO2/Franta", "SiO2/Rodriguez-de-Marcos", "substrate/D263TECO"} <= set(materials())
    for name in materials():
        index = refractive_index(name, [550.0, 600.0])
        assert index.dtype == np.complex128
        assert np.all((index.real > 1.3) & (index.real < 3))
        assert np.all((index.imag >= 0) & (index.imag < 0.05))


@pytest.mark.parametrize(
    ("material", "wavelength", "published"),
    [
        # Malitson's and DeVore's own tables, the glass makers' catalogues
        ("SiO2/Malitson", 589.3, 1.45840),
        ("SiO2/Malitson", 1014.0, 1.45024),
        ("TiO2/Devore-o", 589.3, 2.6131),
        ("TiO2/Devore-e", 589.3, 2.9090),
        ("substrate/D263TECO", 587.6, 1.5230),
        ("substrate/BOROFLOAT33", 587.6, 1.4710),
    ],
)
def test_published_indices(material, wavelength, published):
    assert refractive_index(material, wavelength).real == pytest.approx(published, abs=6e-4)


def test_table_is_met_at_its_nodes_and_linear_between():
    ends = refractive_index("TiO2/Bond-o", [500, 600])
    np.testing.assert_array_equal(ends, [2.7058, 2.6034])
    assert refractive_index("TiO2/Bond-o", 525) == pytest.approx(0.75 * ends[0] + 0.25 * ends[1])


def test_absorption_comes_with_its_own_table():
    k = refractive_index("substrate/D263TECO", [365.0, 500.0]).imag
    np.testing.assert_allclose(k, [3.2221e-07, 3.1959e-08])


def test_out_of_range_names_the_range():
    with pytest.raises(InputError, match=r"435.8 to 643.8 nm"):
        refractive_index("substrate/EagleXG", np.linspace(500, 750, 3))


def test_unknown_material_suggests_one():
    with pytest.raises(InputError, match="TiO2/Franta"):
        refractive_index("TiO2/Frata", 600)


def test_own_csv(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("wavelength,n,k\n700,1.7,-1e-3\n500,1.5,0.02\n")
    np.testing.assert_allclose(
        refractive_index(path, [500, 600, 700]), [1.5 + 0.02j, 1.6 + 0.01j, 1.7]
    )


FORMULAS = {
    "1: 0.1 1.2 0.2": lambda um: np.sqrt(1.1 + 1.2 * um**2 / (um**2 - 0.04)),
    "2: 0.1 1.2 0.04": lambda um: np.sqrt(1.1 + 1.2 * um**2 / (um**2 - 0.04)),
    "3: 2.3 0.01 -2 0.001 -4": lambda um: np.sqrt(2.3 + 0.01 / um**2 + 0.001 / um**4),
    "4: 2.2 0.1 2 0.2 2": lambda um: np.sqrt(2.2 + 0.1 * um**2 / (um**2 - 0.04)),
    "4: 2.2 0.1 2 0.2 2 0.3 0 0.1 1 0.05 -2": lambda um: np.sqrt(
        2.2 + 0.1 * um**2 / (um**2 - 0.04) + 0.3 / (um**2 - 0.1) + 0.05 / um**2
    ),
    "5: 1.5 0.004 -2": lambda um: 1.5 + 0.004 / um**2,
}


@pytest.mark.parametrize("case", FORMULAS)
def test_own_yaml_formulas(tmp_path, case):
    number, constants = case.split(": ")
    path = tmp_path / "own.yml"
    path.write_text(
        f"DATA:\n  - type: formula {number}\n    wavelength_range: 0.4 0.9\n"
        f"    coefficients: {constants}\n"
    )
    wavelength = np.array([450.0, 600.0, 800.0])
    np.testing.assert_allclose(refractive_index(path, wavelength), FORMULAS[case](wavelength / 1e3))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("um.csv", "0.5,1.5\n0.7,1.6\n", "nm, not um"),
        ("torn.csv", "500,1.5\n600\n", "line 2"),
        ("words.csv", "500,1.5\nsix,1.6\n", "line 2"),
        ("empty.csv", "wavelength,n\n", "no row of numbers"),
        ("twice.csv", "500,1.5\n500,1.6\n", "repeated"),
        ("gas.yml", "DATA:\n  - type: formula 9\n", "formula 9"),
        ("not.yml", "hello", "no refractiveindex.info file"),
        (
            "k.yml",
            "DATA:\n  - type: tabulated k\n    data: |\n      0.5 0\n      0.6 0\n",
            "no refr",
        ),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        refractive_index(tmp_path / name, 550)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no file"):
        refractive_index(tmp_path / "none.csv", 550)


def test_an_unknown_name_is_answered_with_those_like_it():
    with pytest.raises(InputError, match=r"Did you mean TiO2/Franta\b"):
        refractive_index("TiO2/Frantta", 550)
    with pytest.raises(InputError, match=r"Known: .*SiO2/Malitson"):
        refractive_index("?", 550)
