"""Samples after a break and dropouts of load cells are found.

Cycles, holds, steps and noise lose no sample.
"""

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys.core.energies.isochoric import stress, stress_columns
from warp_resphys.io.errors import InputError, ResphysWarning
from warp_resphys.learning.identification.material_tests import identify_from_tests
from warp_resphys.learning.identification.specimens import MaterialTest, Specimen
from warp_resphys.learning.identification.stray_samples import strays

STRAINS = np.linspace(0.02, 3.0, 300)
LAW = {"c10": 30e3}


def measured(noise=0.003, seed=0):
    return stress("tension", STRAINS, LAW) * (
        1.0 + noise * np.random.default_rng(seed).standard_normal(300)
    )


def found(strain, curve):
    return {
        words.split()[-1]: np.flatnonzero(rows).tolist()
        for words, rows in strays(strain, curve).items()
    }


@pytest.mark.parametrize("zero", [0.0, 0.05])
@pytest.mark.parametrize("count", [1, 2, 5, 30])
def test_samples_after_a_break(count, zero):
    random = np.random.default_rng(1)
    strain = np.append(STRAINS, 3.0 + 0.01 * np.arange(1, count + 1))
    curve = np.append(measured(), 100.0 * random.standard_normal(count))
    test = MaterialTest("tension", strain, curve, zero=zero * curve.max())
    with pytest.warns(
        ResphysWarning,
        match=f"a: {count} of {300 + count} samples left out, after the specimen broke: sample 301",
    ):
        law = identify_from_tests({"a": test}, density=1070.0)
    assert law.groups == []
    assert law.parameters["c10"] == pytest.approx(30e3, rel=0.005)
    assert law.largest == pytest.approx(3.0)


DROPPED = (0.0, -50e3, 8e6)  # Pa


@pytest.mark.parametrize(
    ("noise", "width", "value"),
    [
        (noise, width, DROPPED[(row + column) % 3])  # each pair once
        for row, noise in enumerate((0.0, 0.003, 0.03))
        for column, width in enumerate((1, 3, 8))
    ],
)
def test_dropouts(noise, width, value):
    curve, places = measured(noise), [30, 150, 240]
    for place in places:
        curve[place : place + width] = value
    expected = [place + k for place in places for k in range(width)]
    assert found(STRAINS, curve) == {"out": expected}
    test = MaterialTest("tension", STRAINS, curve, lines=np.arange(2, 302), zero=0.05 * 237e3)
    assert (
        f"{3 * width} of 300 samples left out, where the load cell dropped out: line 32, strain "
        "0.319" in test.left_out[0]
    )
    with pytest.warns(ResphysWarning, match="dropped out"):
        law = identify_from_tests({"a": test}, density=1070.0)
    assert law.parameters["c10"] == pytest.approx(30e3, rel=0.02)


def test_single_dropouts_of_short_tests():
    """All but the first samples, whose neighbours differ by more than a factor of two."""
    strain = np.linspace(0.15, 3.0, 20)
    for place in range(3, 19):
        curve = stress("tension", strain, LAW)
        curve[place] = 0.0
        assert found(strain, curve) == {"out": [place]}


def test_a_dropout_and_a_break_in_several_samples():
    curve = np.concatenate([measured(), [150e3, 60e3, 4e3, 3e3, 3e3]])
    curve[[30, 150]] = 0.0
    strain = np.append(STRAINS, [3.01, 3.02, 3.03, 3.04, 3.05])
    assert found(strain, curve) == {"out": [30, 150], "broke": [300, 301, 302, 303, 304]}
    strain[300:] = [2.9, 2.7, 2.5, 1.0, 0.0]  # the machine returns at once
    assert found(strain, curve)["broke"] == [300, 301, 302, 303, 304]


LOADINGS = ("tension", "compression", "shear")


@pytest.mark.parametrize(
    ("count", "noise", "kind"),
    [
        (count, noise, LOADINGS[(row + column) % 3])  # each pair once
        for row, count in enumerate((6, 12, 40, 300))
        for column, noise in enumerate((0.0, 0.01, 0.05))
    ],
)
def test_cycles_and_coarse_load_cells_lose_nothing(count, noise, kind):
    random = np.random.default_rng(count)
    most = 0.6 if kind == "compression" else 2.0
    for cycles in (0.5, 1.0, 3.0):
        strain = most * (1.0 - np.abs(2.0 * (np.linspace(0.0, cycles, count) % 1.0) - 1.0))
        loads = np.diff(strain, prepend=-1.0) > 0.0
        for law in (LAW, {"c10": 10e3, "ogden_3": 25e3}):
            exact = stress(kind, strain, law)
            noisy = (
                exact
                * np.where(loads, 1.0, 0.4 + 0.6 * strain / most)
                * (1.0 + noise * random.standard_normal(count))
            )
            size = np.abs(noisy).max() or 1.0
            for curve in (
                noisy,
                np.round(noisy / size * 20.0) * size / 20.0,
                np.maximum(noisy - 0.3 * size, 0.0),
            ):
                assert found(strain, curve) == {}


@pytest.mark.parametrize("count", [60, 200, 2000])
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_relaxation_loses_nothing(count, share):
    seconds = np.linspace(0.0, 40.0, count)
    ramp = np.interp(seconds, [0.0, 1.0, 40.0], [0.0, 1.0, 1.0])
    steps = 0.25 * np.floor(seconds / 10.0 + 1.0) * (seconds > 0.0)
    pulses = 1.0 * (seconds % 10.0 > 5.0)
    cycles = 1.0 - np.abs(seconds % 4.0 / 2.0 - 1.0)
    for strain in (ramp, steps, pulses, cycles):
        for time in (0.1, 1.0, 10.0):
            columns = stress_columns("tension", strain, ("c10", f"prony_{time}"), seconds)
            assert (
                found(
                    strain,
                    30e3 * (1.0 - share) * columns["c10"] + 60e3 * share * columns[f"prony_{time}"],
                )
                == {}
            )


def test_moduli_and_sizes_of_no_elastomer_are_refused():
    strain = np.linspace(0.02, 1.0, 50)
    for factor, said in (
        (1e-3, r"about 60 Pa, softer than all gels \(100 Pa\): check the units"),
        (1e4, "6e\\+02 MPa, harder than rubber"),
    ):
        test = MaterialTest("tension", strain, factor * stress("tension", strain, LAW))
        refuses(InputError, said, identify_from_tests, {"a": test}, density=1070.0)
    for factor in (0.01, 1e3):  # of gels, and of hard rubber
        test = MaterialTest("tension", strain, factor * stress("tension", strain, LAW))
        law = identify_from_tests({"a": test}, density=1070.0)
        assert law.parameters["c10"] == pytest.approx(factor * 30e3, rel=1e-3)
    refuses(
        InputError,
        "length of a specimen is 33 m: give it in m, 0.033 for 33 mm",
        Specimen,
        33.0,
        (6.0, 3.0),
    )
    refuses(
        InputError, "section of a specimen is 3 m: give it in m, 0.003", Specimen, 0.033, (6.0, 3.0)
    )


def test_public_tests_lose_nothing(shared_data):
    from warp_resphys.data.material_tables import read_measured, read_membrane
    from warp_resphys.settings.data_kinds import TableSettings

    columns = TableSettings(columns=(None, None, None, "strain", "stress [MPa]"), header_lines=18)
    paths = sorted((shared_data / "silicone_tensile").glob("*.csv"))
    assert len(paths) == 19
    for path in paths:
        read = read_measured(path, columns).columns
        assert found(read["strain"], read["stress"]) == {}, path.stem
    for path in sorted((shared_data / "ecoflex_membranes").glob("*.csv")):
        table = read_membrane(path)
        for _, rows in table.weights()[0].values():
            assert found(table.height[rows], table.pressure[rows]) == {}, path.stem
