"""The law of a material from tests of specimens: stages and results."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..data.material_tables import read_test
from ..energies.catalogue import law_path, read_law
from ..energies.isochoric import bulk_of
from ..io.arrays import FloatArray
from ..io.atomic import digest
from ..io.errors import DataFileError, InputError, naming
from ..io.progress import show
from ..io.resuming import Stage, StageContext, package_versions, resources_used
from ..io.safe_files import read_json, write_json
from ..learning.identification.material_tests import MeasuredLaw, identify_from_tests
from ..learning.identification.specimens import LEAST_SAMPLES, MaterialTest, Specimen
from ..report.pages.material_page import (
    MaterialMetrics,
    SpecimenResult,
    material_verdict,
    specimen_table,
    write_material_report,
)
from ..settings.run import RunSettings
from ..settings.specimen import MaterialTestData, SimulatedTests
from ..settings.stage_keys import StageSettings
from .files import LAW_FILE, METRICS, REPORT

RESULTS = "material_tests.json"
_CURVE, _DOTS = 81, 400  # points of a curve, and of the measured samples, in figures
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
    """Returns the tests, read or simulated, of which the samples in ``data.range`` count.

    Raises:
        DataFileError: a table cannot be read.
        InputError: samples that are no test, or none in the range.
        ConvergenceError: a simulated specimen has no equilibrium.
    """
    found, paths = {}, table_files(data)
    for number, (name, wanted) in enumerate(data.tests.items()):
        size = wanted.specimen
        specimen = Specimen(size.length, size.section, poissons_ratio, size.indenter, size.cells)
        simulated = specimen if size.is_simulated else None
        if data.simulated is None:
            strain, stress, seconds = _recorded(paths[number], data, specimen)
        else:
            random = np.random.default_rng((seed, number))
            (strain, stress), seconds = _played(wanted.kind, specimen, simulated, data.simulated, random), None
        low, high = data.range or (0.0, np.inf)
        counted = (np.abs(strain) >= low) & (np.abs(strain) <= high)
        if counted.sum() < LEAST_SAMPLES:
            raise InputError(f"data.range leaves {counted.sum()} samples of {name}: give strains that its table has.")
        with naming(f"data.tests.{name}: "):
            found[name] = MaterialTest(
                *(wanted.kind, strain, stress, seconds),
                zero=wanted.zero * float(np.abs(stress[counted]).max()),
                toe=wanted.toe,
                compliance=wanted.compliance * specimen.area / size.length,
                specimen=simulated,
                counted=counted,
            )
    return found


def _recorded(
    path: Path, data: MaterialTestData, specimen: Specimen
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Returns strains, stresses [Pa] and times [s] (N,) of a table, without times that repeat one."""
    read = read_test(path, data.table)
    strain = read["strain"] if "strain" in read else read["displacement"] / specimen.length
    stress = read["stress"] if "stress" in read else read["force"] / specimen.area
    if (seconds := read.get("time")) is None or not len(seconds):
        return strain, stress, None
    later = np.append(True, seconds[1:] > np.maximum.accumulate(seconds)[:-1])
    return strain[later], stress[later], seconds[later]


def _played(
    kind: str, specimen: Specimen, simulated: Specimen | None, played: SimulatedTests, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Returns strains (N,) that a machine with some compliance shows, and stresses (N,) with noise."""
    finer = None if simulated is None else replace(simulated, cells=played.cells)
    strain = np.linspace(0.0, played.strain, played.samples + 1)[1:]
    parameters = {"bulk_1": bulk_of(played.material, specimen.poissons_ratio), **played.material}
    stress = MaterialTest(kind, strain, strain, specimen=finer).response(strain, parameters)[0]
    shown = strain + played.compliance * stress * specimen.area / specimen.length
    return shown, stress * (1.0 + played.noise * random.standard_normal(len(stress)))


def identify_material(context: StageContext) -> None:
    """Writes law.json, and material_tests.json with the errors and the curves.

    Raises:
        InputError: see `tests_of`.
        ConvergenceError: a specimen has no equilibrium.
    """
    settings: StageSettings = context.settings
    data, wanted, material = settings.data, settings.law, settings.simulation.values
    ratio, density = material["poissons_ratio"], material["density"]
    tests = tests_of(data, ratio, settings.seed)
    times = np.geomspace(*wanted.relaxation_times, wanted.branches).tolist()
    known = None if wanted.file is None else read_law(wanted.file)
    options = {"density": density, "poissons_ratio": ratio, "times": times, "known": known}
    law = identify_from_tests(tests, terms=wanted.terms, **options)
    simplest = law if not law.groups else identify_from_tests(tests, terms=(), **options)
    results = {name: _result(name, test, law, simplest) for name, test in tests.items()}
    content = law.content()
    content["data"], content["versions"] = {"name": settings.name, "trials": [*tests]}, dict(package_versions())
    write_json(context.run_dir / LAW_FILE, content)
    write_json(context.run_dir / RESULTS, {"tests": results, "machines": law.machines, "rates": law.rates})


def _result(name: str, test: MaterialTest, law: MeasuredLaw, simplest: MeasuredLaw) -> SpecimenResult:
    """Returns errors and curves of a test: in the range, and beyond it where the specimen is not simulated."""
    size, machine = np.abs(test.strain), law.machines[name]
    high = float(size[test.used].max())
    reach = high * (_REACH if test.specimen is None else 1.0)
    beyond = (size > high) & (size <= reach)
    slope, offset = _hooke(test)
    away = {
        "law": law.away(name, test),
        "neo_hookean": simplest.away(name, test),
        "hooke": (slope * test.strain + offset - test.stress) * test.weights,
    }
    parts = {"range": test.used, "beyond": beyond}
    errors = {part: {model: _error(x[rows]) for model, x in away.items()} for part, rows in parts.items()}
    zero, taut, seen = machine.get("zero", 0.0), test.taut(machine), size <= reach
    slow = test.specimen is None and not law.is_viscous
    covered, half = None, None
    if slow and beyond.sum() >= LEAST_SAMPLES:
        at, width = law.interval(test.kind, taut[beyond])
        covered = float(np.mean(np.abs(at + zero - test.stress[beyond]) <= width))
    if law.is_viscous and test.specimen is None:  # at the times of the test
        shown, curve, simple = taut[seen], law.curve(test, taut)[seen], simplest.curve(test, taut)[seen]
    else:
        shown = np.linspace(0.0, float(taut[seen].max()), _CURVE)
        slowly = replace(test, seconds=None)
        curve, simple = law.curve(slowly, shown), simplest.curve(slowly, shown)
    if slow:
        half = law.interval(test.kind, shown)[1].tolist()
    every = max(1, int(seen.sum()) // _DOTS)
    return SpecimenResult(
        kind=test.kind,
        errors=errors,
        covered=covered,
        strain=taut[seen][::every].tolist(),
        stress=(test.stress - zero)[seen][::every].tolist(),
        shown=shown.tolist(),
        law=curve.tolist(),
        half_width=half,
        neo_hookean=simple.tolist(),
        hooke=(slope * shown + offset - zero).tolist(),
        range=[float(size[test.used].min()), high],
    )


def _error(away: FloatArray) -> float | None:
    """Returns the root mean square of relative errors; None of too few samples."""
    return float(np.sqrt(np.square(away).mean())) if len(away) >= LEAST_SAMPLES else None


def _hooke(test: MaterialTest) -> tuple[float, float]:
    """Returns slope and zero [Pa] of a straight line with the least relative errors in the samples that count."""
    strain, stress, weights = test.strain[test.used], test.stress[test.used], test.weights[test.used]
    columns = np.stack([strain, np.ones_like(strain)], 1)[:, : 2 if test.zero else 1]
    found = np.linalg.lstsq(columns * weights[:, None], stress * weights)[0]
    return float(found[0]), float(found[1]) if len(found) > 1 else 0.0


def report_material(context: StageContext) -> None:
    """Writes report.html and its figures."""
    run: RunSettings = context.settings
    write_material_report(
        context.run_dir / REPORT, material_metrics(context.run_dir), run, read_json(context.run_dir / LAW_FILE)
    )


def material_metrics(folder: Path) -> MaterialMetrics:
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
    show(run.heading, specimen_table(metrics), *material_verdict(metrics, law, run), f"Report: {folder / REPORT}")
