"""The law of a material from tests of specimens: stages and results."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..data.material_tables import read_test
from ..energies.catalogue import law_path, read_law
from ..energies.isochoric import bulk_of
from ..io.arrays import BoolArray, FloatArray
from ..io.atomic import digest
from ..io.errors import DataFileError, InputError, naming
from ..io.progress import show
from ..io.resuming import Stage, StageContext, package_versions, resources_used
from ..io.safe_files import read_json, write_json
from ..learning.identification.material_tests import MeasuredLaw, identify_from_tests
from ..learning.identification.specimens import LEAST_SAMPLES, MaterialTest, Specimen
from ..report.pages.material_page import TestMetrics, TestResult, test_table, test_verdict, write_material_report
from ..settings.run import RunSettings
from ..settings.specimen import MaterialTestData, MaterialTestSettings, SimulatedTests
from ..settings.stage_keys import StageSettings
from .files import LAW_FILE, METRICS, REPORT

RESULTS = "material_tests.json"
_REACH = 2.0  # ratio of the largest strain that is predicted to the largest that the law is identified from


def material_stages(run: RunSettings, data: MaterialTestData) -> list[Stage]:
    """Returns the stages of a run with some tests."""
    files = {str(path): digest(path) for path in table_files(data)}
    if run.law is not None and run.law.file is not None:
        files[run.law.file] = digest(law_path(run.law.file))
    settings = StageSettings.reading(run, "simulation", "law", "data", "seed", "name", files=files)
    return [
        Stage("identify_law", identify_material, (LAW_FILE, RESULTS), settings),
        Stage("report", report_material, (REPORT,), run, ("identify_law",)),
    ]


def table_files(data: MaterialTestData) -> list[Path]:
    """Returns the paths of the tables.

    Raises:
        DataFileError: one is missing.
    """
    if data.folder is None:
        return []
    paths = [Path(data.folder).expanduser() / str(test.file) for test in data.tests.values()]
    if lost := [path for path in paths if not path.is_file()]:
        raise DataFileError(f"there is no file {lost[0]}: set data.folder and data.tests.NAME.file.")
    return paths


def tests_of(data: MaterialTestData, poissons_ratio: float, seed: int) -> dict[str, MaterialTest]:
    """Returns all samples of the tests, read or simulated.

    Raises:
        DataFileError: a table cannot be read.
        InputError: samples that are no test.
        ConvergenceError: a simulated specimen has no equilibrium.
    """
    found, paths = {}, table_files(data)
    for number, (name, wanted) in enumerate(data.tests.items()):
        size = wanted.specimen
        specimen = Specimen(size.length, size.section, poissons_ratio, size.indenter, size.cells)
        if data.simulated is None:
            read = read_test(paths[number], data.table)
            strain = read["strain"] if "strain" in read else read["displacement"] / size.length
            stress = read["stress"] if "stress" in read else read["force"] / specimen.area
            seconds = read.get("time")
            if seconds is not None and len(seconds):  # Logs of machines repeat some times.
                later = np.append(True, seconds[1:] > np.maximum.accumulate(seconds)[:-1])
                strain, stress, seconds = strain[later], stress[later], seconds[later]
        else:
            strain, stress = _simulated(wanted, specimen, data.simulated, np.random.default_rng((seed, number)))
            seconds = None
        with naming(f"data.tests.{name}: "):
            found[name] = MaterialTest(
                *(wanted.kind, strain, stress, seconds),
                zero=wanted.zero * float(np.abs(stress).max(initial=0.0)),
                toe=wanted.toe,
                compliance=wanted.compliance * specimen.area / size.length,
                specimen=specimen if size.ends == "glued" or size.indenter is not None else None,
            )
    return found


def _simulated(
    wanted: MaterialTestSettings, specimen: Specimen, played: SimulatedTests, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Returns strains (N,) that a machine with some compliance shows, and stresses (N,) with noise."""
    simulated = specimen if wanted.specimen.ends == "glued" or specimen.indenter is not None else None
    finer = None if simulated is None else replace(simulated, cells=played.cells)
    strain = np.linspace(0.0, played.strain, played.samples + 1)[1:]
    exact = MaterialTest(wanted.kind, strain, strain, specimen=finer)
    parameters = {"bulk_1": bulk_of(played.material, specimen.poissons_ratio), **played.material}
    stress = exact.response(strain, parameters)[0]
    shown = strain + played.compliance * stress * specimen.area / specimen.length
    return shown, stress * (1.0 + played.noise * random.standard_normal(len(stress)))


def _within(test: MaterialTest, low: float, high: float) -> BoolArray:
    """Marks the samples (N,) between two strains."""
    size = np.abs(test.strain)
    return np.asarray((size >= low) & (size <= high))


def identify_material(context: StageContext) -> None:
    """Writes law.json, and material_tests.json with the errors and the curves.

    Raises:
        InputError: see `tests_of`, or a range without samples.
        ConvergenceError: a specimen has no equilibrium.
    """
    settings: StageSettings = context.settings
    data, wanted, material = settings.data, settings.law, settings.simulation.values
    ratio, density = material["poissons_ratio"], material["density"]
    tests = tests_of(data, ratio, settings.seed)
    low, high = data.range or (0.0, max(float(np.abs(test.strain).max()) for test in tests.values()))
    learned = {}
    for name, test in tests.items():
        if (rows := _within(test, low, high)).sum() < LEAST_SAMPLES:
            raise InputError(f"data.range leaves {rows.sum()} samples of {name}: give strains that its table has.")
        learned[name] = test.chosen(rows)
    times = np.geomspace(*wanted.relaxation_times, wanted.branches).tolist()
    known = None if wanted.file is None else read_law(wanted.file)
    options = {"density": density, "poissons_ratio": ratio, "times": times, "known": known}
    law = identify_from_tests(learned, terms=wanted.terms, **options)
    simplest = law if not law.groups else identify_from_tests(learned, terms=(), **options)
    results = {name: _result(name, test, learned[name], law, simplest, high) for name, test in tests.items()}
    content = law.content()
    content["data"], content["versions"] = {"name": settings.name, "trials": [*tests]}, dict(package_versions())
    write_json(context.run_dir / LAW_FILE, content)
    write_json(context.run_dir / RESULTS, {"tests": results, "machines": law.machines, "rates": law.rates})


def _result(
    name: str, test: MaterialTest, learned: MaterialTest, law: MeasuredLaw, simplest: MeasuredLaw, high: float
) -> TestResult:
    """Returns errors and curves of a test."""
    reach = high * (_REACH if test.specimen is None else 1.0)  # a specimen is simulated in the range alone
    rows = _within(test, high, reach) & (np.abs(test.strain) > high)
    beyond = test.chosen(rows) if rows.sum() >= LEAST_SAMPLES else None
    parts = {"range": learned, "beyond": beyond}
    machine = law.machines[name]
    hooke = _hooke(learned)
    errors: dict[str, dict[str, float | None]] = {}
    for part, samples in parts.items():
        models = {
            "law": None if samples is None else law.away(name, samples),
            "neo_hookean": None if samples is None else simplest.away(name, samples),
            "hooke": None
            if samples is None
            else (hooke[0] * samples.strain + hooke[1] - samples.stress) * samples.weights,
        }
        errors[part] = {key: None if x is None else float(np.sqrt(np.square(x).mean())) for key, x in models.items()}
    shown = np.linspace(0.0, min(reach, float(np.abs(test.strain).max())), 81)
    zero, covered = machine.get("zero", 0.0), None
    value, half = (law.interval(test.kind, shown)) if test.specimen is None else (None, None)
    if test.specimen is None and beyond is not None:
        at, width = law.interval(test.kind, beyond.taut(machine))
        covered = float(np.mean(np.abs(at + zero - beyond.stress) <= width))
    measured = test.chosen(_within(test, 0.0, reach))
    every = max(1, len(measured.strain) // 400)
    return TestResult(
        kind=test.kind,
        errors=errors,
        covered=covered,
        strain=measured.taut(machine)[::every].tolist(),
        stress=(measured.stress - zero)[::every].tolist(),
        shown=shown.tolist(),
        law=value.tolist() if value is not None else law.curve(test, shown).tolist(),
        half_width=None if half is None else half.tolist(),
        neo_hookean=simplest.curve(test, shown).tolist(),
        hooke=(hooke[0] * shown).tolist(),
        range=[float(np.abs(learned.strain).min()), high],
    )


def _hooke(test: MaterialTest) -> tuple[float, float]:
    """Returns slope and zero [Pa] of a straight line with the least relative errors."""
    columns = np.stack([test.strain, np.ones_like(test.strain)], 1)[:, : 2 if test.zero else 1]
    found = np.linalg.lstsq(columns * test.weights[:, None], test.stress * test.weights)[0]
    return float(found[0]), float(found[1]) if len(found) > 1 else 0.0


def report_material(context: StageContext) -> None:
    """Writes report.html and its figures."""
    run: RunSettings = context.settings
    write_material_report(
        context.run_dir / REPORT, material_metrics(context.run_dir), run, read_json(context.run_dir / LAW_FILE)
    )


def material_metrics(folder: Path) -> TestMetrics:
    """Returns the content of metrics.json."""
    return {
        **read_json(folder / RESULTS),
        "parameters": read_json(folder / LAW_FILE)["parameters"],
        **resources_used(folder, ["identify_law"]),
        "versions": package_versions(),
        "device": "cpu",
    }


def print_material(run: RunSettings, folder: Path) -> None:
    """Writes metrics.json, and prints the errors and the verdict."""
    metrics, law = material_metrics(folder), read_json(folder / LAW_FILE)
    write_json(folder / METRICS, metrics)
    show(run.heading, test_table(metrics), *test_verdict(metrics, law, run), f"Report: {folder / REPORT}")
