"""Tables of a run with material tests: files and patterns,
a name for each test, sizes, and what the report says.
"""

import numpy as np
import pytest

from support.command_line import outcome, refusal
from support.refusals import refuses
from warp_resphys.core.energies.isochoric import stress
from warp_resphys.experiment import material_stages
from warp_resphys.experiment.material_stages import table_files
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.safe_files import read_json
from warp_resphys.settings.specimen import MaterialTestData

BAR = {"length": 0.033, "width": 0.006, "thickness": 0.003}


def written(path, c10=30e3, strain=None, after=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    strain = np.linspace(0.02, 1.0, 50) if strain is None else strain
    rows = [
        f"{e:.6f},{1e-3 * s:.6f}"
        for e, s in zip(strain, stress("tension", strain, {"c10": c10}), strict=True)
    ]
    path.write_text("\n".join(["strain,stress [kPa]", *rows]) + after, encoding="utf-8")


def settings(folder, **files):
    tests = {
        name: {"kind": "tension", "file": str(file), "specimen": BAR}
        for name, file in files.items()
    }
    return MaterialTestData.model_validate(
        {"kind": "material_tests", "folder": str(folder), "tests": tests}
    )


def names(folder, **files):
    fitted, held, _ = material_stages.tests_of(settings(folder, **files), 0.4995, 0)
    assert held == {}
    return {name: round(float(test.stress[-1]) / 3.5) for name, test in fitted.items()}


@pytest.fixture
def folder(tmp_path):
    """Specimens in folders of their own, whose files have one name, as machines write them."""
    for number in (1, 2, 3):
        written(tmp_path / f"sample_{number}.is_tens" / "Specimen_1.csv", 1e3 * number)
    return tmp_path


def test_files_of_one_name_are_tests_of_their_own(folder):
    files = {f"batch_{number}": f"sample_{number}.is_tens/Specimen_1.csv" for number in (1, 2, 3)}
    assert names(folder, **files) == {"batch_1": 1000, "batch_2": 2000, "batch_3": 3000}
    by_folder = {f"sample_{number}.is_tens/Specimen_1": 1000 * number for number in (1, 2, 3)}
    assert names(folder, all="*/Specimen_1.csv") == by_folder
    written(folder / "sample_1.is_tens" / "Specimen_1.txt", 4e3)
    assert names(folder, one=files["batch_1"], all="sample_1*/*", two="sample_2.is_tens/*.csv") == {
        "one": 1000,
        "sample_1.is_tens/Specimen_1": 4000,
        "sample_2.is_tens/Specimen_1": 2000,
    }
    assert names(folder, all="sample_1*/*") == {
        "sample_1.is_tens/Specimen_1.csv": 1000,
        "sample_1.is_tens/Specimen_1.txt": 4000,
    }
    written(folder / "a.csv", 5e3)
    written(folder / "b.csv", 6e3)
    assert names(folder, b="a.csv", others="*.csv") == {"b": 5000, "b.csv": 6000}
    assert names(folder, a="?.csv", others="[ab].csv") == {
        **{"a, a.csv": 5000, "a, b.csv": 6000},
        **{"others, a.csv": 5000, "others, b.csv": 6000},
    }


def test_a_file_that_exists_is_no_pattern(tmp_path):
    odd = ("tension [batch 2].csv", "tension (1).csv", "what?.csv", "star*.csv")
    for number, name in enumerate(odd, start=1):
        written(tmp_path / "data" / name, 1e3 * number)
        assert names(tmp_path / "data", test=name) == {"test": 1000 * number}
        assert names(tmp_path / "data", test=tmp_path / "data" / name) == {"test": 1000 * number}
        assert names(tmp_path / "data", test=f"../data/{name}") == {"test": 1000 * number}
    lost = tmp_path / "data" / "lost.csv"
    for file in ("lost.csv", "**", "**lost.csv", "lost*.csv", str(lost)):
        said = "there is no file .*: set data.folder and data.tests.test.file"
        refuses(DataFileError, said, table_files, settings(tmp_path / "data", test=file))
    refuses(
        DataFileError, "is a folder, not a file", table_files, settings(tmp_path / "data", test=".")
    )


def test_the_report_names_what_was_left_out(tmp_path):
    written(tmp_path / "x" / "test.csv", 30e3, after="\n1.01,0.12\n1.02,OVL\n1.03,0.1\n")
    written(tmp_path / "y" / "test.csv", 30e3)
    bar = "specimen: {length: 0.033, width: 0.006, thickness: 0.003, ends: free}"
    arguments = (
        *("experiment=material_test", "data.simulated=null", f"data.folder={tmp_path}"),
        f"data.tests={{tension: {{kind: tension, file: '*/test.csv', {bar}}}}}",
        f"hydra.run.dir={tmp_path}/run",
    )
    ran = outcome(*arguments)
    assert ran.code == 0, ran
    said = " ".join(ran.out.split())
    left = (
        "x/test: 1 of 53 samples left out: line 53, without a number in each column.",
        "x/test: 2 of 52 samples left out, after the specimen broke: line 52, strain 1.01, "
        "stress 0.12 kPa, and 1 other.",
    )
    report = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    for sentence in left:
        assert sentence in said
        assert sentence in report
    law = read_json(tmp_path / "run" / "law.json")
    assert law["data"]["trials"] == ["x/test", "y/test"]
    assert law["parameters"]["c10"] == pytest.approx(30e3, rel=1e-3)
    in_mm = bar.replace("0.033", "33").replace("0.006", "6").replace("0.003", "3")
    tests = f"data.tests={{tension: {{kind: tension, file: x/test.csv, {in_mm}}}}}"
    assert "length is 33 m: sizes are in m, write 0.033 for 33 mm" in refusal(*arguments, tests)
