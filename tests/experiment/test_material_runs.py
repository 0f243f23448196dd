"""Laws of silicones from tables of testing machines, through the command line,
and the silicones of the package.
"""

from pathlib import Path

import numpy as np
import pytest

import warp_resphys
from support.command_line import outcome, refusal
from support.configured import composed
from support.refusals import refuses
from warp_resphys.core.energies.isochoric import stress
from warp_resphys.data.material_tables import read_test
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.safe_files import read_json
from warp_resphys.io.settings import parse
from warp_resphys.learning import MaterialTest, Membrane, identify_from_tests
from warp_resphys.settings.body import MaterialSettings
from warp_resphys.settings.data_kinds import TableSettings
from warp_resphys.settings.run import RunSettings

SILICONE = {"c10": 10e3, "ogden_3": 25e3}
BAR = "specimen: {length: 0.033, width: 0.006, thickness: 0.003, ends: free}"


def written(folder, header="time [s], displacement [mm], force [N]", noise=0.005):
    """A table of a tensile test up to 200 %, with repeated times, as machines write them."""
    strain = np.linspace(0.01, 2.0, 200)
    force = stress("tension", strain, SILICONE) * 18e-6
    force *= 1.0 + noise * np.random.default_rng(0).standard_normal(200)
    rows = [
        f"{0.1 * k:.1f}, {33.0 * e:.4f}, {f:.5f}"
        for k, (e, f) in enumerate(zip(strain, force, strict=True))
    ]
    path = folder / "tension.csv"
    path.write_text("\n".join([header, *rows[:150], rows[149], *rows[150:]]), encoding="utf-8")
    return path


def arguments(folder, *more):
    tests = f"data.tests={{tension: {{kind: tension, file: tension.csv, {BAR}}}}}"
    common = ("experiment=material_test", "data.simulated=null", f"data.folder={folder}", tests)
    return [*common, "data.range=[0.05, 1.0]", f"hydra.run.dir={folder}/run", *more]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tests")
    written(folder)
    result = outcome(*arguments(folder))
    return folder / "run", result


def test_a_table_gives_a_law(run):
    folder, result = run
    law, metrics = read_json(folder / "law.json"), read_json(folder / "metrics.json")
    assert law["groups"] == ["ogden_3"]
    for name, true in SILICONE.items():
        assert law["parameters"][name] == pytest.approx(true, abs=3.0 * law["deviation"][name])
    assert law["stretches"] == pytest.approx([2.0**-0.5, 2.0], rel=0.01)
    assert law["modes"] == ["tension"]
    errors = metrics["tests"]["tension"]["errors"]
    assert errors["range"]["law"] < 0.01 < errors["range"]["neo_hookean"]
    assert errors["beyond"]["law"] < 0.1 * errors["beyond"]["neo_hookean"]
    assert metrics["tests"]["tension"]["covered"] == 1.0
    assert metrics["rates"] == pytest.approx([0.1, 0.1], rel=0.01)
    assert "Predicted rest" in (folder / "report.html").read_text(encoding="utf-8")
    assert (folder / "figures" / "curves.png").stat().st_size > 1_000
    assert "neo-Hookean term and Ogden's term of exponent 3" in result.out
    assert np.isclose(
        warp_resphys.read_material(str(folder / "law.json")).values["c10"], law["parameters"]["c10"]
    )


def test_tables_of_other_machines(tmp_path):
    path = tmp_path / "other.csv"
    path.write_text(
        "Material;Ecoflex\n\nZeit (s);Dehnung;Spannung (MPa)\n0,1;0,1;0,002\n0,2;0,2;0,004\n;;\n",
        "utf-8",
    )
    described = read_test(
        path, TableSettings(columns=("time [s]", "strain [%]", "stress [MPa]"), header_lines=3)
    )
    np.testing.assert_allclose(described["strain"], [0.001, 0.002])
    named = read_test(
        path,
        TableSettings(
            names={"Dehnung": "strain", "Spannung (MPa)": "stress [MPa]"}, header_lines=2
        ),
    )
    np.testing.assert_allclose(named["stress"], [2e3, 4e3])
    assert [*named] == ["strain", "stress"]
    path.write_text(
        "Time,Extension,Displacement,Force\n[sec],,(mm),(N)\n0,0,1,2\n1,0,2,3\n2,0,3,4\n", "utf-8"
    )
    units_below = read_test(path)
    np.testing.assert_allclose(units_below["displacement"], [1e-3, 2e-3, 3e-3])
    assert [*units_below] == ["time", "displacement", "force"]
    path.write_text("Force (N),strain (mm/mm)\n2,0.1\n4,0.2\n", "utf-8")
    np.testing.assert_allclose(read_test(path)["strain"], [0.1, 0.2])
    path.write_text("Strain,Stress (kPa)\n0.1,2\n0.2,4\n", "utf-8")
    np.testing.assert_allclose(read_test(path)["stress"], [2e3, 4e3])


def test_refused_tables(tmp_path):
    def read(text, table=None):
        path = tmp_path / "test.csv"
        path.write_text(text, "utf-8")
        return read_test(path, table)

    refuses(
        DataFileError,
        r"the column 'stress' has no unit: write it as in 'stress \[Pa\]",
        read,
        "strain,stress\n0.1,2\n0.2,4",
    )
    refuses(DataFileError, "has the unit 'bananas'", read, "strain,stress [bananas]\n0.1,2\n0.2,4")
    refuses(
        DataFileError,
        "has 0 of the columns stress and force, of which a test has one. It has 'strain', 'time",
        read,
        "strain,time [s]\n0.1,2\n0.2,4",
    )
    refuses(
        DataFileError,
        "has 2 of the columns strain and disp",
        read,
        "strain,displacement [mm],force [N]\n1,2,3\n",
    )
    refuses(DataFileError, "no line of numbers below a header", read, "strain,stress [kPa]\n")
    names = TableSettings(names={"Kraft": "force [N]"})
    refuses(DataFileError, "no single column is named 'Kraft'", read, "Weg,Kraf\n1,2\n", names)
    columns = TableSettings(columns=("strain", "pressure [kPa]"))
    refuses(DataFileError, r"data\.table has the column 'pressure \[kPa\]'", read, "1,2\n", columns)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("data.tests.tension.file=other.csv", "there is no file"),
        ("data.range=[1.9, 1.92]", "data.range leaves 3 samples of tension"),
        ("law=null", "law is null, but data.kind is material_tests"),
        ("~simulation.density", "simulation lacks density"),
        ("data.tests.tension.specimen.diameter=0.01", "diameter, or width and thickness"),
        ("data.tests.tension.kind=indentation", "kind is indentation if, and only if"),
        ("data.tests.tension.specimen.length=0", "length"),
        ("law.file=foo", "there is no law foo"),
        ("law.trials=2", "law.trials is for laws from trials"),
        (
            "+simulation.youngs_modulus=1e5",
            "simulation has youngs_modulus, which tests of specimens identify",
        ),
        ("data.scaled=true", "law.file is null, but data.scaled multiplies a law"),
        ("+data.tests.tension.held_out=true", "all tests are held out"),
        (
            "data.tests.tension.kind=bulge",
            "a bulge test has a membrane, all others have a specimen",
        ),
        (
            "data.tests={lift: {kind: bulge, file: a.csv, membrane: {radius: 0.04}}}",
            "bulge tests scale a law",
        ),
        (
            "data.tests={lift: {kind: bulge, membrane: {radius: 0.04}}}",
            "bulge tests are not simulated",
        ),
    ],
)
def test_refused_configurations(tmp_path, change, said):
    written(tmp_path)
    assert said in refusal(*arguments(tmp_path, change))


def lifted(folder, name, rings, factor, forces):
    """A table of a membrane of a law with twice the moduli of Ecoflex 00-30, under weights [N]."""
    law = {"c10": factor * warp_resphys.silicone("Ecoflex 00-30").values["c10"]}
    sizes = "ring1_radius_mm,ring1_width_mm,ring2_radius_mm,ring2_width_mm"
    head = f"thickness_mm,contact_radius_mm,{sizes}"
    rows = [
        f"# {head} = [4.0, 15.0, {rings}, nan, nan]",
        "height_mm,pressure_Pa,lifted_force_N",
        "2,5000,3",
    ]
    for force in forces:
        ring = () if "nan" in rings else (tuple(1e-3 * float(size) for size in rings.split(",")),)
        heights = np.linspace(10.0, 20.0, 11)
        pressures = Membrane(0.04, 0.004, 0.015, force, ring).response(heights / 40.0, law)[0]
        rows += [
            f"{height:.1f},{p:.2f},{force:g}" for height, p in zip(heights, pressures, strict=True)
        ]
    (folder / name).write_text("\n".join(rows), encoding="utf-8")


def test_a_law_that_is_scaled_on_one_membrane_predicts_another(tmp_path):
    lifted(tmp_path, "membrane_0.csv", "nan, nan", 2.0, (3.0,))
    lifted(tmp_path, "membrane_5.csv", "27.0, 3.0", 2.0, (3.0, 4.0))
    sizes = [f"data.tests.{name}.membrane.radius=0.04" for name in ("membrane_0", "others")]
    given = ("experiment=membrane", f"data.folder={tmp_path}", "law.file=ecoflex_00_30", *sizes)
    said = outcome(*given, "data.range=[0.2, 0.55]", f"hydra.run.dir={tmp_path}/run").out
    metrics = read_json(tmp_path / "run" / "metrics.json")
    assert metrics["factor"] == pytest.approx(2.0, rel=2e-3)
    held = {name: one["held_out"] for name, one in metrics["tests"].items()}
    assert held == {"membrane_0, 3 N": False, "membrane_5, 3 N": True, "membrane_5, 4 N": True}
    for one in metrics["tests"].values():
        assert one["errors"]["range"]["law"] < 0.005
        assert one["errors"]["range"]["unscaled"] > 0.1
    assert "The law is the given one times 2. It predicts 2 tests" in " ".join(said.split())
    assert (tmp_path / "run" / "figures" / "curves.png").stat().st_size > 1_000
    # Of two weights.
    (tmp_path / "membrane_0.csv").write_bytes((tmp_path / "membrane_5.csv").read_bytes())
    assert "data.range leaves 4 samples under 3 N" in refusal(*given, "data.range=[0.2, 0.34]")


def test_silicones_by_name():
    material = warp_resphys.silicone("Ecoflex 00-30")
    assert (
        material.values["c10"]
        == read_json(Path(warp_resphys.__file__).parent / "laws/ecoflex_00_30.json")["parameters"][
            "c10"
        ]
    )
    assert (
        warp_resphys.silicone("DragonSkin 30").values
        == warp_resphys.silicone("dragon_skin_30").values
    )
    settings = MaterialSettings.model_validate(
        {"model": "silicone", "name": "ecoflex_00_30", "density": 1100.0}
    )
    assert settings.model == "law"
    assert settings.values == {**settings.values, "c10": material.values["c10"], "density": 1100.0}
    refuses(InputError, "did you mean .*ecoflex_00_30", warp_resphys.silicone, "Ecoflex 00-31")
    values = composed("experiment=tendon_rod")
    values["simulation"] = {"model": "silicone", "name": "foo"}
    refuses(
        InputError,
        "simulation.*name is 'foo', which has no law here: choose from dragon_skin_10",
        parse,
        RunSettings,
        values,
    )


@pytest.mark.slow
def test_simulated_tensile_test(tmp_path):
    """The experiment as it is: noise of 1 %, glued ends, a finer true mesh; the machine yields by
    0.2 mm.
    """
    yielding = ("data.simulated.compliance=4.2e-5", "data.tests.tension.compliance=4e-5")
    assert outcome("experiment=material_test", f"hydra.run.dir={tmp_path}", *yielding).code == 0
    law = read_json(tmp_path / "law.json")
    assert law["groups"] == []
    assert law["parameters"]["c10"] == pytest.approx(30e3, rel=0.02)
    assert law["stretches"] == pytest.approx([1.6**-0.5, 1.6], rel=0.02)


@pytest.mark.parametrize(
    "name",
    [
        "Dragon Skin 10 MEDIUM",
        "Dragon Skin 20",
        "Dragon Skin 30",
        "Ecoflex 00-30",
        "Ecoflex 00-50",
        "Mold Star 16 FAST",
    ],
)
def test_public_silicones_beyond_their_tests(shared_data, name):
    """Identified from 5 to 100 % of strain: 3 % there (5 % Ecoflex),
    12 % up to 200 %, within the 90 % interval.
    """
    columns = TableSettings(
        columns=("time [s]", None, None, "strain", "stress [MPa]"), header_lines=18
    )
    read = read_test(shared_data / "silicone_tensile" / f"{name}.csv", columns)
    inside, beyond = (
        (read["strain"] >= low) & (read["strain"] <= 2.0 * low + 0.9 * (low < 1))
        for low in (0.05, 1.0)
    )
    test = MaterialTest("tension", read["strain"][inside], read["stress"][inside], zero=5e3)
    law = identify_from_tests({"tension": test}, density=1070.0)
    assert law.errors["tension"] < (0.05 if "Ecoflex" in name else 0.03)
    further = MaterialTest("tension", read["strain"][beyond], read["stress"][beyond])
    assert np.sqrt(np.square(law.away("tension", further)).mean()) < 0.12
    value, half = law.interval("tension", further.strain)
    assert np.mean(np.abs(value + law.machines["tension"]["zero"] - further.stress) <= half) > 0.9
