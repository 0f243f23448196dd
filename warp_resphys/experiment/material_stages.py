"""The law of a material from tests of specimens: stages and results."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from ..core.energies.catalogue import LawContent, law_path, read_law
from ..core.energies.isochoric import bulk_of, shear_modulus
from ..data.material_checks import MeasuredTable, check_unit
from ..data.material_tables import read_measured, read_membrane
from ..io.arrays import BoolArray, FloatArray
from ..io.atomic import digest
from ..io.errors import ConvergenceError, DataFileError, InputError, ResphysWarning, naming
from ..io.progress import show
from ..io.resuming import Stage, StageContext, package_versions, resources_used, run_stages
from ..io.safe_files import read_json, write_json
from ..learning.identification.material_tests import MeasuredLaw, identify_from_tests
from ..learning.identification.membranes import Membrane
from ..learning.identification.scaling import scale_to_tests
from ..learning.identification.specimens import LEAST_SAMPLES, MaterialTest, Specimen
from ..report.pages.material_page import (
    MaterialMetrics,
    SpecimenResult,
    material_verdict,
    specimen_table,
    write_material_report,
)
from ..settings.run import RunSettings
from ..settings.specimen import (
    MaterialTestData,
    MaterialTestSettings,
    MembraneSettings,
    SimulatedTests,
)
from ..settings.stage_keys import StageSettings
from .files import LAW_FILE, METRICS, REPORT

RESULTS = "material_tests.json"
_CURVE, _DOTS = 81, 400  # points of a curve, and of the measured samples, in figures
# Ratio of the largest strain that is predicted to the largest that the law is identified from.
_REACH = 2.0


def material_stages(run: RunSettings, data: MaterialTestData) -> list[Stage]:
    """Returns the stages of a run with some tests."""
    paths = chain.from_iterable(table_files(data).values())
    files = {str(path): digest(path) for path in paths}
    if run.law is not None and run.law.file is not None:
        files[run.law.file] = digest(law_path(run.law.file))
    settings = StageSettings.reading(run, "simulation", "law", "data", "seed", "name", files=files)
    return [
        Stage("identify_law", identify_material, (LAW_FILE, RESULTS), settings),
        Stage("report", report_material, (REPORT,), run, ("identify_law",)),
    ]


def table_files(data: MaterialTestData) -> dict[str, list[Path]]:
    """Returns the paths of the tables by test.

    A pattern leaves out the files that other tests name.

    Raises:
        DataFileError: one is missing.
    """
    if data.folder is None:
        return {}
    folder = Path(data.folder).expanduser()
    single = {
        name: folder / str(test.file)
        for name, test in data.tests.items()
        if (folder / str(test.file)).is_file()
    }
    named, found = {path.resolve() for path in single.values()}, dict[str, list[Path]]()
    for name, test in data.tests.items():
        pattern = str(test.file)
        try:
            matches = [] if name in single else sorted(folder.glob(pattern))
        except (ValueError, NotImplementedError, IndexError):
            # No pattern: an absolute path, '.' or 'a**'.
            matches = []
        files = [path for path in matches if path.is_file() and path.resolve() not in named]
        if name not in single and not files:
            place = folder / pattern
            what = (
                f"{place} is a folder, not a file"
                if place.is_dir()
                else f"there is no file {place}"
            )
            raise DataFileError(f"{what}: set data.folder and data.tests.{name}.file.")
        found[name] = files or [single[name]]
    return found


def names_of(
    data: MaterialTestData, tables: Mapping[str, Sequence[Path]]
) -> dict[tuple[str, Path], str]:
    """Returns a name of its own for each table: that of its test,
    or where a pattern finds several that of the file.

    Files of one name are named with their folders, and files that differ by their extension with
    it.
    """
    places = [(name, path) for name, paths in tables.items() for path in paths]
    folder = Path(data.folder or "").expanduser()
    several = {name for name, path in places if path != folder / str(data.tests[name].file)}
    within = {path: Path(os.path.relpath(path, folder)) for _, path in places}
    forms: list[Callable[[str, Path], str]] = [
        lambda _, path: path.stem,
        lambda _, path: within[path].with_suffix("").as_posix(),
        lambda _, path: within[path].as_posix(),
        lambda name, path: f"{name}, {within[path].as_posix()}",
    ]
    names = dict[tuple[str, Path], str]()
    for form in forms:
        names = {
            (name, path): form(name, path) if name in several else name for name, path in places
        }
        if len({*names.values()}) == len(places):
            break
    return names


def tests_of(
    data: MaterialTestData, poissons_ratio: float, seed: int
) -> tuple[dict[str, MaterialTest], dict[str, MaterialTest], list[str]]:
    """Returns the tests that the law is identified from, those held out,
    read or simulated, and what was left out.

    The samples in ``data.range`` count. A table of several is a test by its name, one of a membrane
    a test by weight.

    Raises:
        DataFileError: a table cannot be read.
        InputError: samples that are no test, or none in the range.
        ConvergenceError: a simulated specimen has no equilibrium.
    """
    fitted = dict[str, MaterialTest]()
    held = dict[str, MaterialTest]()
    tables = table_files(data)
    names, notes = names_of(data, tables), list[str]()
    for number, (name, wanted) in enumerate(data.tests.items()):
        found = held if wanted.held_out else fitted
        for path in tables.get(name, [None]):
            called = name if path is None else names[name, path]
            with naming(f"data.tests.{name}: "):
                if wanted.membrane is not None and path is not None:
                    tests, said = _inflated(path, called, data, wanted.membrane, poissons_ratio)
                    found |= tests
                else:
                    random = np.random.default_rng((seed, number))
                    found[called], said = _deformed(
                        path, called, data, wanted, poissons_ratio, random
                    )
            notes += [f"{called}: {note}" for note in said]
    for name, test in (fitted | held).items():
        notes += [f"{name}: {note}" for note in test.left_out]
    return fitted, held, notes


def _inflated(
    path: Path, name: str, data: MaterialTestData, wanted: MembraneSettings, poissons_ratio: float
) -> tuple[dict[str, MaterialTest], list[str]]:
    """Returns the tests of a membrane under each weight,
    with the samples in ``data.range``, and what was left out.
    """
    table, tests = read_membrane(path), dict[str, MaterialTest]()
    strain = table.height / wanted.radius
    within = _counted(strain, data, name)
    weights, notes = table.weights()
    for called, (force, rows) in weights.items():
        chosen = within & rows
        if chosen.sum() < LEAST_SAMPLES:
            raise InputError(
                f"data.range leaves {chosen.sum()} samples under {called}: "
                "give heights that were measured."
            )
        membrane = Membrane(
            radius=wanted.radius,
            thickness=table.thickness,
            cap=table.cap,
            force=force,
            rings=table.rings,
            ring_modulus=wanted.ring_modulus,
            poissons_ratio=poissons_ratio,
        )
        test = MaterialTest("bulge", strain[chosen], table.pressure[chosen], specimen=membrane)
        tests[f"{name}, {called}"] = test
    return tests, notes


def _counted(strain: FloatArray, data: MaterialTestData, name: str) -> BoolArray:
    """Returns (N,) whether strains are in ``data.range``."""
    low, high = data.range or (0.0, np.inf)
    counted = (np.abs(strain) >= low) & (np.abs(strain) <= high)
    if counted.sum() < LEAST_SAMPLES:
        raise InputError(
            f"data.range leaves {counted.sum()} samples of {name}: give strains that its table has."
        )
    return np.asarray(counted)


def _deformed(
    path: Path | None,
    name: str,
    data: MaterialTestData,
    wanted: MaterialTestSettings,
    poissons_ratio: float,
    random: np.random.Generator,
) -> tuple[MaterialTest, list[str]]:
    """Returns a test of a specimen, read or simulated, and what was left out of its table."""
    size = wanted.specimen
    assert size is not None
    specimen = Specimen(size.length, size.section, poissons_ratio, size.indenter, size.cells)
    simulated = specimen if size.is_simulated else None
    lines = None
    notes = list[str]()
    if path is not None:
        strain, stress, table = _recorded(path, data, specimen)
        seconds = table.columns.get("time")
        lines = table.lines
        notes = [*table.notes]
    else:
        assert data.simulated is not None
        strain, stress = _played(wanted.kind, specimen, simulated, data.simulated, random)
        seconds = None
    counted = _counted(strain, data, name)
    test = MaterialTest(
        kind=wanted.kind,
        strain=strain,
        stress=stress,
        seconds=seconds,
        toe=wanted.toe,
        compliance=wanted.compliance * specimen.area / size.length,
        specimen=simulated,
        counted=counted,
        lines=lines,
    )
    return replace(test, zero=wanted.zero * float(np.abs(stress[test.used]).max())), notes


def _recorded(
    path: Path, data: MaterialTestData, specimen: Specimen
) -> tuple[FloatArray, FloatArray, MeasuredTable]:
    """Strains and stresses (N,) [Pa] of a specimen, and the table that they are read from."""
    table = read_measured(path, data.table)
    read = table.columns
    strain = read["strain"] if "strain" in read else read["displacement"] / specimen.length
    stress = read["stress"] if "stress" in read else read["force"] / specimen.area
    check_unit(table, strain, stress, path)
    return strain, stress, table


def _played(
    kind: str,
    specimen: Specimen,
    simulated: Specimen | None,
    played: SimulatedTests,
    random: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Strains (N,) that a machine with some compliance shows, and stresses (N,) with noise."""
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
    data, wanted = settings.data, settings.law
    material = settings.simulation.values
    ratio, density = material["poissons_ratio"], material["density"]
    tests, held, notes = tests_of(data, ratio, settings.seed)
    known = None if wanted.file is None else read_law(wanted.file)
    unscaled, factor = None, None
    with warnings.catch_warnings():
        # Which report and terminal name.
        warnings.filterwarnings("ignore", ".* left out", ResphysWarning)
        if data.scaled:
            assert known is not None
            law = scale_to_tests(tests, known, density=density, poissons_ratio=ratio)
            simple: LawContent = {
                **known,
                "parameters": {"c10": 0.5 * shear_modulus(known["parameters"])},
            }
            simplest = (
                law
                if not law.groups
                else scale_to_tests(tests, simple, density=density, poissons_ratio=ratio)
            )
            factor = shear_modulus(law.parameters) / shear_modulus(known["parameters"])
            unscaled = replace(
                law, columns={name: value / factor for name, value in law.columns.items()}
            )
        else:
            times = np.geomspace(*wanted.relaxation_times, wanted.branches).tolist()
            options = {"density": density, "poissons_ratio": ratio, "times": times, "known": known}
            law = identify_from_tests(tests, terms=wanted.terms, **options)
            simplest = law if not law.groups else identify_from_tests(tests, terms=(), **options)
    models = {"law": law, "neo_hookean": simplest} | (
        {} if unscaled is None else {"unscaled": unscaled}
    )
    results = {
        name: _result(name, test, models, name in held) for name, test in (tests | held).items()
    }
    content = law.content()
    content["data"], content["versions"] = (
        {"name": settings.name, "trials": [*tests]},
        dict(package_versions()),
    )
    write_json(context.run_dir / LAW_FILE, content)
    write_json(
        context.run_dir / RESULTS,
        {
            "tests": results,
            "machines": law.machines,
            "rates": law.rates,
            "factor": factor,
            "left_out": notes,
        },
    )


def _result(
    name: str, test: MaterialTest, models: Mapping[str, MeasuredLaw], held_out: bool
) -> SpecimenResult:
    """Returns errors and curves of a test: in the range,
    and beyond it where the specimen is not simulated.
    """
    law, inflated = models["law"], test.kind == "bulge"
    size, machine = np.abs(test.strain), law.machines.get(name, {})
    high = float(size[test.used].max())
    reach = high * (_REACH if test.specimen is None else 1.0)
    seen = test.valid & (size <= reach)
    beyond = seen & (size > high)
    zero, taut = machine.get("zero", 0.0), test.taut(machine)
    slow = test.specimen is None and not law.is_viscous
    in_time = law.is_viscous and test.specimen is None  # curves at the times of the test
    shown = (
        taut[seen]
        if in_time
        else np.linspace(size.min() if inflated else 0.0, float(taut[seen].max()), _CURVE)
    )
    away, curves = dict[str, FloatArray | None](), dict[str, FloatArray | None]()
    for kind, model in models.items():
        try:
            away[kind] = (
                model.away(name, test) if name in law.machines else test.away(model.columns, {})
            )
            curves[kind] = (
                model.curve(test, taut)[seen]
                if in_time
                else model.curve(replace(test, seconds=None), shown)
            )
        except ConvergenceError:  # of a law that is too soft for a membrane's load
            away[kind] = curves[kind] = None
    if not inflated:
        slope, offset = _hooke(test)
        away["hooke"] = (slope * test.strain + offset - test.stress) * test.weights
        curves["hooke"] = slope * shown + offset - zero
    parts = {"range": test.used, "beyond": beyond}
    errors = {
        part: {k: None if x is None else _error(x[rows]) for k, x in away.items()}
        for part, rows in parts.items()
    }
    covered, half = None, None
    if slow:
        half = law.interval(test.kind, shown)[1].tolist()
        if beyond.sum() >= LEAST_SAMPLES:
            at, width = law.interval(test.kind, taut[beyond])
            covered = float(np.mean(np.abs(at + zero - test.stress[beyond]) <= width))
    every = max(1, int(seen.sum()) // _DOTS)
    return SpecimenResult(
        kind=test.kind,
        held_out=held_out,
        errors=errors,
        covered=covered,
        strain=taut[seen][::every].tolist(),
        stress=(test.stress - zero)[seen][::every].tolist(),
        shown=shown.tolist(),
        curves={kind: None if curve is None else curve.tolist() for kind, curve in curves.items()},
        half_width=half,
        range=[float(size[test.used].min()), high],
    )


def _error(away: FloatArray) -> float | None:
    """Returns the root mean square of relative errors; None of too few samples."""
    return float(np.sqrt(np.square(away).mean())) if len(away) >= LEAST_SAMPLES else None


def _hooke(test: MaterialTest) -> tuple[float, float]:
    """Returns slope and zero [Pa] of a straight line
    with the least relative errors in the samples that count.
    """
    strain = test.strain[test.used]
    stress = test.stress[test.used]
    weights = test.weights[test.used]
    columns = np.stack([strain, np.ones_like(strain)], 1)[:, : 2 if test.zero else 1]
    found = np.linalg.lstsq(columns * weights[:, None], stress * weights)[0]
    return float(found[0]), float(found[1]) if len(found) > 1 else 0.0


def report_material(context: StageContext) -> None:
    """Writes report.html and its figures."""
    run: RunSettings = context.settings
    write_material_report(
        context.run_dir / REPORT,
        material_metrics(context.run_dir),
        run,
        read_json(context.run_dir / LAW_FILE),
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


def check_material(run: RunSettings) -> None:
    """Checks that there are files with tests.

    Raises:
        InputError: there are none.
    """
    assert run.material_tests is not None
    table_files(run.material_tests)


def run_material(run: RunSettings, folder: Path) -> None:
    """Runs the stages of tests of a material, and prints its law."""
    assert run.material_tests is not None
    run_stages(material_stages(run, run.material_tests), folder)
    print_material(run, folder)


def print_material(run: RunSettings, folder: Path) -> None:
    """Writes metrics.json, and prints the errors and the verdict."""
    metrics, law = material_metrics(folder), read_json(folder / LAW_FILE)
    write_json(folder / METRICS, metrics)
    show(
        run.heading,
        specimen_table(metrics),
        *material_verdict(metrics, law, run),
        f"Report: {folder / REPORT}",
    )
