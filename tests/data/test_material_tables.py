"""Tables of material tests: which columns and lines are read,
clocks, units, and what is refused or named.
"""

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys.core.energies.isochoric import stress
from warp_resphys.data.material_tables import read_measured, read_membrane, read_test
from warp_resphys.io.errors import DataFileError, ResphysWarning
from warp_resphys.settings.data_kinds import TableSettings

STRAINS = np.linspace(0.02, 1.0, 50)


def curve(strain=STRAINS, c10=30e3):
    """Stresses [kPa]"""
    return 1e-3 * stress("tension", strain, {"c10": c10})


def table(path, head, *columns, before="", after=""):
    rows = [
        ",".join(cell if isinstance(cell, str) else f"{cell:.6g}" for cell in row)
        for row in zip(*columns, strict=True)
    ]
    path.write_text(before + "\n".join([head, *rows]) + "\n" + after, encoding="utf-8")
    return path


def test_columns_of_text_are_skipped_and_named(tmp_path):
    words = ["pull"] * 50
    path = table(
        tmp_path / "a.csv",
        "SetName,Time_S,Displacement_mm,Force_mN,state",
        words,
        STRAINS,
        STRAINS,
        curve(),
        words,
    )
    read = read_measured(path)
    np.testing.assert_allclose(read.columns["displacement"], 1e-3 * STRAINS, rtol=1e-5)
    np.testing.assert_allclose(read.columns["force"], 1e-3 * curve(), rtol=1e-5)
    assert read.notes == ("Columns of text are not read: 'SetName', 'state'.",)
    clock = [f"2026-03-04 10:00:{k:02d}" for k in range(50)]
    assert [
        *read_measured(table(path, "time,strain,stress [kPa]", clock, STRAINS, curve())).columns
    ] == ["strain", "stress"]


def test_results_before_or_after_the_samples(tmp_path):
    results = "Results Table 1\n,Maximum Force (N),Strain at Break (%)\n1,12.5,310\n2,13.5,320\n\n"
    head = "Time (s),Extension (mm),Load (N)"
    path = table(tmp_path / "a.csv", head, STRAINS, STRAINS, curve(), before=results)
    np.testing.assert_allclose(read_test(path)["force"], curve(), rtol=1e-5)
    other = table(path, "Time (s),Weg (mm),Kraft (N)", STRAINS, STRAINS, curve(), before=results)
    refuses(
        DataFileError,
        r"It has 'Time \(s\)', 'Weg \(mm\)', 'Kraft \(N\)': name them",
        read_test,
        other,
    )
    after = table(path, "strain,stress [kPa]", STRAINS, curve(), after="Maximum,\n")
    with pytest.warns(
        ResphysWarning, match="1 of 51 samples left out: line 52, without a number in each column"
    ):
        assert len(read_test(after)["strain"]) == 50


def test_lines_without_a_number_are_counted(tmp_path):
    cells = [f"{value:.4f}" for value in curve()]
    cells[3], cells[8], cells[20], cells[21] = "OVL", "", "nan", "inf"
    read = read_measured(table(tmp_path / "a.csv", "strain,stress [kPa]", STRAINS, cells))
    assert read.notes == (
        "4 of 50 samples left out: lines 5, 10, 22 and 1 more, without a number in each column.",
    )
    assert len(read.lines) == len(read.columns["strain"]) == 46
    assert read.lines[3] == 6
    cells[3] = "12.3.4"
    broken = table(tmp_path / "a.csv", "strain,stress [kPa]", STRAINS, cells)
    refuses(
        DataFileError,
        r"line 5: '12\.3\.4' in the column of stress is not a number",
        read_test,
        broken,
    )
    for text in (
        "strain,force [mN]\n0.1,998\n0.2,1,012\n",
        "strain,force [mN]\n0.1,1,998\n0.2,2,012\n",
    ):
        (tmp_path / "a.csv").write_text(text, encoding="utf-8")
        said = "line . has 3 cells where its header has 2: leave out marks between thousands"
        refuses(DataFileError, said, read_test, tmp_path / "a.csv")


def test_a_clock_that_begins_anew_goes_on(tmp_path):
    """As in the steps of a method: ramp and hold, loading and unloading."""
    strain = np.concatenate([STRAINS, np.ones(20), STRAINS[::-1]])
    ramp, hold = 0.1 * np.arange(1, 51), 0.5 * np.arange(1, 21)
    expected = np.concatenate([ramp, ramp[-1] + hold, ramp[-1] + hold[-1] + ramp])
    for first in (0.0, 1.0):  # the clock of a step begins at zero, or after one interval
        seconds = np.concatenate([ramp, hold - 0.5 * (1.0 - first), ramp])
        read = read_measured(
            table(
                tmp_path / "a.csv", "time [s],strain,stress [kPa]", seconds, strain, curve(strain)
            )
        )
        assert len(read.columns["strain"]) == 120
        np.testing.assert_allclose(np.diff(read.columns["time"])[:48], 0.1, rtol=1e-5)
        assert (np.diff(read.columns["time"]) > 0.0).all()
        if first:
            np.testing.assert_allclose(read.columns["time"], expected, rtol=1e-5)
        assert read.notes == (
            "The time begins anew in lines 52, 72: it was taken to go on from the line before.",
        )


def test_repeated_times_and_clocks_that_are_wrong(tmp_path):
    head, seconds = "time [s],strain,stress [kPa]", 0.1 * np.arange(50)
    repeated = seconds.copy()
    repeated[[7, 30]] = repeated[[6, 29]]
    read = read_measured(table(tmp_path / "a.csv", head, repeated, STRAINS, curve()))
    assert read.notes == (
        "2 of 50 samples left out: lines 9, 32, which repeat the time before them.",
    )
    for clock, said in (
        (np.minimum(seconds, 2.0), "stands still in line 23"),
        (np.where(seconds > 3.0, seconds - 2.0, seconds), "falls from 3 to 1.1 s in line 33"),
    ):
        read = read_measured(table(tmp_path / "a.csv", head, clock, STRAINS, curve()))
        assert len(read.columns["strain"]) == 50
        assert "time" not in read.columns
        assert read.notes == (
            f"The time {said}: times are not read, which relaxing branches need.",
        )


@pytest.mark.parametrize("head", ["strain,stress [kPa]", "time [s],strain,stress [kPa]"])
def test_two_specimens_in_a_table_are_refused(tmp_path, head):
    columns = [np.tile(one, 2) for one in (0.1 * np.arange(50), STRAINS, curve())]
    columns = columns[-len(head.split(",")) :]
    path = table(tmp_path / "a.csv", head, *columns)
    refuses(
        DataFileError,
        "line 52: the strain falls from 1 to 0.02 at once, as where another specimen",
        read_test,
        path,
    )
    for first, second in ((50, 15), (20, 50)):  # that do not reach the same strain
        some = [np.concatenate([one[:first], one[50 : 50 + second]]) for one in columns]
        shorter = table(tmp_path / "b.csv", head, *some)
        refuses(
            DataFileError, f"line {first + 2}: the strain falls from .* at once", read_test, shorter
        )
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines[:51], lines[0], *lines[51:]]), encoding="utf-8")
    refuses(
        DataFileError,
        "2 tables, whose numbers begin in lines 2, 53: write each specimen",
        read_test,
        path,
    )
    described = TableSettings(columns=tuple(head.split(",")), header_lines=1)
    refuses(DataFileError, "line 52 repeats the header of line 1", read_test, path, described)


def test_steps_and_cycles_are_one_test(tmp_path):
    """Steps to and fro, a release after a hold, cycles with unloading,
    and cycles of loading with the time.
    """
    steps = np.repeat([0.0, 0.5, 0.0, 0.5, 0.0], 12)
    release = np.concatenate([STRAINS, np.ones(30), np.zeros(30)])
    cycles = np.tile(np.concatenate([STRAINS, STRAINS[::-1]]), 3)
    for strain in (steps, release, cycles, np.tile(STRAINS, 3)):
        seconds = 0.1 * np.arange(len(strain))
        timed = table(
            tmp_path / "a.csv", "time [s],strain,stress [kPa]", seconds, strain, curve(strain)
        )
        assert len(read_test(timed)["strain"]) == len(strain)
    for strain in (steps, release, cycles):
        bare = table(tmp_path / "a.csv", "strain,stress [kPa]", strain, curve(strain))
        assert len(read_test(bare)["strain"]) == len(strain)


@pytest.mark.parametrize(
    ("most", "c10"),
    [(0.8, 20e3), (3.5, 30e3), (18.0, 30e3), (18.0, 300e3), (6.0, 500e3), (1.5, 30e3), (12.0, 5e3)],
)
def test_per_cent_without_a_unit_is_asked_about(tmp_path, most, c10):
    percent = np.linspace(most / 60, most, 60)
    path = table(tmp_path / "a.csv", "Strain,Stress (kPa)", percent, curve(0.01 * percent, c10))
    refuses(
        DataFileError,
        r"the column 'Strain' has no unit and reaches .*: write 'Strain \[%\]'",
        read_test,
        path,
    )
    for unit, factor in (("%", 0.01), ("1", 1.0), ("-", 1.0), ("m/m", 1.0)):
        path = table(
            tmp_path / "a.csv", f"Strain [{unit}],Stress (kPa)", percent, curve(0.01 * percent, c10)
        )
        np.testing.assert_allclose(read_test(path)["strain"], factor * percent, rtol=1e-5)


def test_large_strains_of_elastomers_are_not(tmp_path):
    for law in ({"c10": 10e3, "ogden_3": 5e3}, {"c10": 30e3}, {"c10": 200e3, "c30": 300.0}):
        for most in (1.2, 2.0, 3.0, 7.0):
            strain = np.linspace(0.02, most, 80)
            path = table(
                tmp_path / "a.csv",
                "strain,stress [kPa]",
                strain,
                1e-3 * stress("tension", strain, law),
            )
            assert len(read_test(path)["strain"]) == 80


@pytest.mark.parametrize("kind", ["tension", "compression"])
def test_a_stretch_is_no_strain(tmp_path, kind):
    strain = STRAINS if kind == "tension" else 0.5 * STRAINS
    stretch = 1.0 + strain if kind == "tension" else 1.0 - strain
    load = 1e-3 * stress(kind, strain, {"c10": 30e3})
    path = table(tmp_path / "a.csv", "strain,stress [kPa]", stretch, load)
    refuses(
        DataFileError,
        "in line 2, where the load is least, as a stretch is: name its column 'stretch'",
        read_test,
        path,
    )
    path = table(tmp_path / "a.csv", "stretch,stress [kPa]", stretch, load)
    np.testing.assert_allclose(read_test(path)["strain"], strain, rtol=1e-4)


def test_a_break_near_a_strain_of_one_is_no_stretch(tmp_path):
    strain = np.append(STRAINS, [1.01, 1.02])
    path = table(tmp_path / "a.csv", "strain,stress [kPa]", strain, np.append(curve(), [0.12, 0.1]))
    assert len(read_test(path)["strain"]) == 52


def membrane(path, *forces):
    rings = "ring1_radius_mm,ring1_width_mm,ring2_radius_mm,ring2_width_mm"
    head = f"thickness_mm,contact_radius_mm,{rings}"
    rows = [f"{10 + k % 6},5000,{force:.6g}" for k, force in enumerate(forces)]
    lines = [
        f"# {head} = [2.0, 15.0, nan, nan, nan, nan]",
        "height_mm,pressure_Pa,lifted_force_N",
        *rows,
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    return read_membrane(path)


def test_weights_of_a_membrane_have_names_of_their_own(tmp_path):
    weights, notes = membrane(
        tmp_path / "a.csv", *[24.517] * 6, *[24.525] * 6, *[14.715] * 6
    ).weights()
    assert {name: int(rows.sum()) for name, (_, rows) in weights.items()} == {
        "14.715 N": 6,
        "24.517 N": 6,
        "24.525 N": 6,
    }
    assert notes == []


def test_weights_that_scatter_are_one(tmp_path):
    random = np.random.default_rng(0)
    measured = np.concatenate(
        [force * (1.0 + 1e-3 * random.standard_normal(40)) for force in (14.7, 24.5)]
    )
    weights, notes = membrane(tmp_path / "a.csv", *measured, 20.0, 20.1).weights()
    assert [*weights] == ["14.7 N", "24.5 N"]
    assert [int(rows.sum()) for _, rows in weights.values()] == [40, 40]
    assert weights["24.5 N"][0] == pytest.approx(24.5, rel=1e-3)
    assert notes[0] == "Forces that differ by less than 1 % count as one weight."
    assert notes[1] == "2 of 82 samples left out: under 20 N, fewer than 5 of a weight."


def test_public_tables_keep_all_lines(shared_data):
    """Times of five files are wrong: a spreadsheet made 41.0 s into 40.10 s, which is said."""
    columns = TableSettings(
        columns=("time [s]", None, None, "strain", "stress [MPa]"), header_lines=18
    )
    told = dict[str, int]()
    for path in sorted((shared_data / "silicone_tensile").glob("*.csv")):
        read = read_measured(path, columns)
        lines = path.read_text(encoding="utf-8").splitlines()[18:]
        assert len(read.columns["strain"]) == sum(line.strip(";") != "" for line in lines)
        told |= {path.stem: len(read.notes)} if read.notes else {}
    assert told == dict.fromkeys(
        (
            "Dragon Skin FX Pro",
            "Ecoflex 00-30",
            "Ecoflex 00-35 FAST",
            "Ecoflex 00-50",
            "PlatSil Gel 10",
        ),
        1,
    )
