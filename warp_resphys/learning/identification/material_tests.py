"""Identification of an elastic law from tests of specimens:
tension, compression, shear, indentation, relaxation.

The coefficients of the law, not negative, and unknown constants of each machine minimise

    sum_t K_t / N_t sum_n ((P(x_n) + z - p_n) / (noise w_n))^2 + priors,
    x = e - toe - compliance p

over the N_t samples of test t, with the nominal stress P of the law, the measured stress p and
strain e, the zero z of the load cell, the strain at which the specimen becomes taut, and the
compliance of the machine, which a crosshead shows as strain of the specimen. Errors are relative: w
is p, but at least a fiftieth of its largest value. As a curve is smooth, its samples count as
K_t = 20 independent ones at most.

Terms are chosen by what they predict: every class of laws is fitted to the lower part of the
strains, and the smallest that predicts the upper part about as well as the best is fitted to all of
them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, combinations
from typing import Final

import numpy as np
import scipy.optimize

from ...core.energies.catalogue import LawContent, LawTest, TriedClass, law_content
from ...core.energies.convex_material import ConvexMaterial
from ...core.energies.isochoric import (
    KINDS,
    TERMS,
    bulk_of,
    path_of,
    shear_modulus,
    stress,
    stress_columns,
)
from ...core.fem.integration_points import LODE
from ...io.arrays import BoolArray, Brief, FloatArray
from ...io.errors import InputError, listed
from .law import branches_of
from .specimens import MaterialTest

BEYOND: Final = 0.25  # see `MeasuredLaw.interval`
SAMPLES: Final = 20  # independent samples of a curve
NOISE: Final = 0.01  # relative error that has the weight of one standard deviation of a prior
# Loading modes by kind of test.
_MODES: Final = {
    "tension": "tension",
    "planar": "shear",
    "shear": "shear",
    "compression": "compression",
    "biaxial": "compression",
}
_CLOSE: Final = 1.25  # ratio to the smallest error beyond that range that a smaller class may have
_EXACT: Final = 0.1 * NOISE  # error beyond the range that no larger class needs to lower
_NEEDLESS: Final = 1e-3  # coefficient over the shear modulus that is left out
_LARGEST_CLASS: Final = 2  # elastic terms beside c10
_MOST: Final = 5.0  # standard deviations of a machine's constants
_STEPS: Final = 30  # of Gauss-Newton
_HALVINGS: Final = 8  # of a step that does not lower the residuals
_QUANTILE: Final = 1.645  # of the normal distribution, for 90 %
_RELATIVE_DEVIATION: Final = 0.05  # of the shear modulus of a known law that states none


@dataclass(frozen=True)
class MeasuredLaw(Brief):
    """A law that was identified from tests of specimens.

    Attributes:
        parameters: of `ConvexMaterial`, by name.
        deviation: standard deviations of the coefficients.
        machines: constants of the machines by test: zero [Pa], toe, compliance [1/Pa].
        errors: root mean squares of the relative errors by test, with these constants.
        classes: classes that were tried, none for a law that was scaled; ``residual`` is their
            error in the lower part of the strains, ``validation`` that in the upper part.
        groups: terms of the chosen one, besides c10.
        stretches: least and largest principal stretch, of simulated specimens as if they deformed
            homogeneously.
        modes: of loading of the specimens, see `fem.integration_points.LODE`.
        largest: largest strain of the tests.
        rates: least and largest rate of strain [1/s]; None without times.
        columns: coefficients by the names of `energies.isochoric.stress_columns`.
        covariance: (P, P) of the coefficients in ``deviation``.
    """

    parameters: dict[str, float]
    deviation: dict[str, float]
    machines: dict[str, dict[str, float]]
    errors: dict[str, float]
    classes: list[TriedClass]
    groups: list[str]
    stretches: tuple[float, float]
    modes: list[str]
    largest: float
    rates: tuple[float, float] | None
    columns: dict[str, float] = field(repr=False)
    covariance: FloatArray = field(repr=False)

    def away(self, name: str, test: MaterialTest) -> FloatArray:
        """Returns the relative errors (N,) in a test,
        with the constants of the machine of the test of a name.
        """
        return test.away(self.columns, self.machines[name])

    @property
    def is_viscous(self) -> bool:
        """Whether stresses depend on the rate."""
        return any(
            name.startswith(("prony", "shear_visc")) and value
            for name, value in self.columns.items()
        )

    def curve(self, test: MaterialTest, strain: FloatArray) -> FloatArray:
        """Returns the stress (N,) [Pa] at strains (N,) of a test's specimen:
        at its times, or in slow loading.
        """
        if test.specimen is None and test.seconds is None:
            return stress(test.kind, strain, self.parameters)
        return test.response(strain, self.columns)[0]

    def interval(
        self, kind: str, strain: FloatArray, beyond: float = BEYOND
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the nominal stress (N,) in slow loading,
        and the half-width (N,) of its 90 % interval [Pa].

        In the range of the tests the interval covers the posterior of the coefficients and the
        misfit of the law. Beyond, laws err in ways that no test within the range shows: over 19
        silicones of a public database, and tests up to 50 to 200 % of strain, about nine of ten
        errors up to twice that strain were below 0.25 log2 of the ratio of strains, which is
        ``beyond`` (docs/results/silicones.md).
        """
        columns = stress_columns(kind, strain, tuple(self.deviation))
        slopes = np.stack([*columns.values()], 1)
        value = stress(kind, strain, self.parameters)
        ratio = np.maximum(np.abs(strain) / self.largest, 1.0)
        known = np.einsum("np,pq,nq->n", slopes, self.covariance, slopes)
        misfit = _QUANTILE * max(self.errors.values()) * value
        return value, np.sqrt(
            _QUANTILE**2 * known + misfit**2 + (beyond * np.log2(ratio) * value) ** 2
        )

    @property
    def shear_deviation(self) -> float:
        """Standard deviation of the shear modulus at small strains [Pa]."""
        shares = np.array([shear_modulus({name: 1.0}) for name in self.deviation])
        return math.sqrt(float(shares @ self.covariance @ shares))

    def content(self) -> LawContent:
        """Returns the content of law.json."""
        errors = {tuple(tried["groups"]): tried["validation"] for tried in self.classes}
        tested: LawTest = {
            "trials": [*self.errors],
            "split": "upper part of the strains" if self.classes else "all samples",
            "law": errors.get(tuple(self.groups), max(self.errors.values())),
            "below": errors.get(()),
        }
        return {
            **law_content(ConvexMaterial.model, self.parameters),
            "accepted": True,
            "groups": self.groups,
            "deviation": self.deviation,
            "shear_deviation": self.shear_deviation,
            "validation": tested,
            "classes": self.classes,
            "stretches": [*self.stretches],
            "modes": self.modes,
        }


def identify_from_tests(
    tests: Mapping[str, MaterialTest],
    *,
    density: float,
    poissons_ratio: float = 0.4995,
    terms: Sequence[str] = ("c01", "ogden_3"),
    times: Sequence[float] = (),
    known: LawContent | None = None,
) -> MeasuredLaw:
    """Identifies a law from tests of specimens.

    Args:
        tests: tests by name.
        density: of the material [kg/m^3].
        poissons_ratio: of the material at small strains, which these tests hardly show.
        terms: elastic terms that are tried beside c10, two at most in a law, named as in
            `ConvexMaterial`.
        times: relaxation times of the branches that are tried [s]; none for slow tests.
        known: law of the same material from another source. Its shear modulus at small strains is a
            prior, with its standard deviation (``shear_deviation``, or 5 %), and its viscosity and
            branches are part of the law.

    Raises:
        InputError: no test, branches without times, or a shear modulus that no elastomer has.
        ConvergenceError: a simulated specimen has no equilibrium.
    """
    if not tests:
        raise InputError("tests is empty: give one test or more.")
    search = _Search(
        tests, density, poissons_ratio, tuple(f"prony_{float(time)!r}" for time in times), known
    )
    unknown = [term for term in terms if not TERMS.fullmatch(term) or term == "c10"]
    if unknown:
        raise InputError(
            f"terms has {unknown[0]!r}: choose from c20, c30, "
            "c01, c02, and ogden_3, ogden_m3 and so on."
        )
    if not 0.0 < poissons_ratio < 0.5:
        raise InputError(
            f"poissons_ratio is {poissons_ratio:g}: give one between 0 and 0.5, such as 0.4995."
        )
    late = [name for name, test in tests.items() if test.seconds is None and test.specimen is None]
    if (times or search.viscous) and (
        late or all(test.specimen is not None for test in tests.values())
    ):
        raise InputError(
            f"{listed(late or [*tests])}: times of a homogeneous test are missing, which "
            "relaxing branches need: give them, or no branches."
        )
    for name, test in tests.items():
        test.check(name)
    sizes = range(_LARGEST_CLASS + 1)
    groups = [*chain.from_iterable(combinations(terms, size) for size in sizes)]
    lower = [test.lower for test in tests.values()]
    tried, classes = [search.fit(chosen, lower) for chosen in groups], list[TriedClass]()
    for chosen, fit in zip(groups, tried, strict=True):
        upper = [test.used & ~rows for test, rows in zip(tests.values(), lower, strict=True)]
        errors = [fit.error(lower), fit.error(upper)]
        parameters = search.parameters(fit)
        classes.append(
            TriedClass(
                groups=[*chosen], parameters=parameters, residual=errors[0], validation=errors[1]
            )
        )
    errors_beyond = [float(one["validation"] or 0.0) for one in classes]
    best = next(
        k
        for k, error in enumerate(errors_beyond)
        if error <= max(_CLOSE * min(errors_beyond), _EXACT)
    )
    return search.law(search.fit(groups[best]), classes, best)


@dataclass(frozen=True)
class _Fit:
    """Least squares of a class of laws."""

    tests: Sequence[MaterialTest]
    coefficients: dict[str, float]
    law: dict[str, float]  # coefficients with those that are known
    machines: list[dict[str, float]]
    covariance: FloatArray  # (P, P) of the coefficients

    def error(self, rows: Sequence[BoolArray] | None = None) -> float:
        """Root mean square of the relative errors in some samples of the tests."""
        away = [
            test.away(self.law, machine)
            for test, machine in zip(self.tests, self.machines, strict=True)
        ]
        counted = [test.used for test in self.tests] if rows is None else rows
        chosen = [one[of] for one, of in zip(away, counted, strict=True) if of.any()]
        return math.sqrt(float(np.mean([np.square(one).mean() for one in chosen])))


@dataclass(frozen=True)
class _Search:
    """Least squares of classes of laws; for the attributes see `identify_from_tests`."""

    tests: Mapping[str, MaterialTest]
    density: float
    poissons_ratio: float
    branches: tuple[str, ...]
    known: LawContent | None

    @property
    def viscous(self) -> dict[str, float]:
        """Viscosity and branches of the known law, as coefficients of columns."""
        given: Mapping[str, float] = {} if self.known is None else self.known["parameters"]
        found = {name: value for name, value in given.items() if name == "shear_viscosity"}
        times = {
            name: f"prony_{float(given[name.replace('modulus', 'time')])!r}"
            for name in given
            if "prony_mod" in name
        }
        return found | {column: given[name] for name, column in times.items()}

    def fit(self, terms: Sequence[str], rows: Sequence[BoolArray] | None = None) -> _Fit:
        """Fits a class of laws.

        Args:
            terms: elastic terms beside c10.
            rows: samples of each test; all if None.
        """
        tests, names = [*self.tests.values()], ("c10", *terms, *self.branches)
        unit = max(
            float(np.abs(test.stress[test.used]).max() / np.abs(test.strain[test.used]).max())
            for test in tests
        )
        of_machines = [
            (number, name) for number, test in enumerate(tests) for name in test.deviations
        ]
        scales = np.array(
            [unit] * len(names) + [tests[number].deviations[name] for number, name in of_machines]
        )
        system = _System(self, tests, names, of_machines, scales, rows)
        ends = (
            np.array([0.0] * len(names) + [-_MOST] * len(of_machines)),
            np.full(len(scales), _MOST),
        )
        ends[1][: len(names)] = np.inf
        x = np.zeros(len(scales))
        x[0] = 0.2
        residual, slopes = system.linear(x)
        for _ in range(_STEPS):
            goal = scipy.optimize.lsq_linear(slopes, slopes @ x - residual, ends, method="bvls").x
            step, before = np.clip(goal, *ends) - x, float(residual @ residual)
            for halved in range(_HALVINGS):
                step = step if halved == 0 else 0.5 * step
                residual, slopes = system.linear(x + step)
                if float(residual @ residual) <= before * (1.0 + 1e-9):
                    break
            x = np.clip(x + step, *ends)
            if np.abs(step).max() < 1e-6 * np.abs(x).max():
                break
        return system.fit(x, residual, slopes)

    def parameters(self, fit: _Fit) -> dict[str, float]:
        """Parameters of a `ConvexMaterial`."""
        shear = shear_modulus(fit.coefficients)
        elastic = [name for name in fit.coefficients if TERMS.fullmatch(name)]
        kept = {
            n: x for n in elastic if (x := fit.coefficients[n]) > _NEEDLESS * shear or n == "c10"
        }
        branches = {
            n: x for n, x in fit.law.items() if n.startswith("prony_") and x > _NEEDLESS * shear
        }
        viscosity = {name: value for name, value in fit.law.items() if name == "shear_viscosity"}
        relaxing = branches_of(
            [*branches.values()], [float(name.removeprefix("prony_")) for name in branches]
        )
        return {
            "density": self.density,
            **kept,
            "bulk_1": bulk_of(fit.coefficients, self.poissons_ratio),
            **viscosity,
            **relaxing,
        }

    def law(self, fit: _Fit, classes: list[TriedClass], best: int) -> MeasuredLaw:
        """Returns the law of a fit to all samples that count.

        Raises:
            InputError: no elastic term resists.
        """
        if not shear_modulus(fit.coefficients) > 0.0:
            raise InputError(
                "no elastic term explains these stresses: "
                "check the signs and the columns of the tests."
            )
        parameters, tests = self.parameters(fit), [*self.tests.values()]
        kept = [k for k, name in enumerate(fit.coefficients) if name in parameters]
        names = [name for name in fit.coefficients if name in parameters]
        covariance = fit.covariance[np.ix_(kept, kept)]
        away = [
            test.away(fit.law, machine)[test.used]
            for test, machine in zip(tests, fit.machines, strict=True)
        ]
        strains = [np.append(test.strain[test.used], 0.0) for test in tests]
        kinds = [test.kind if test.kind in KINDS else "compression" for test in tests]
        stretches = [
            path_of(kind, strain).stretches for kind, strain in zip(kinds, strains, strict=True)
        ]
        rates = [
            np.abs(np.diff(test.strain) / np.diff(test.seconds))
            for test in tests
            if test.seconds is not None
        ]
        return MeasuredLaw(
            parameters=parameters,
            deviation=dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
            machines=dict(zip(self.tests, fit.machines, strict=True)),
            errors={
                name: math.sqrt(float(np.square(one).mean()))
                for name, one in zip(self.tests, away, strict=True)
            },
            classes=classes,
            groups=classes[best]["groups"],
            stretches=(float(min(map(np.min, stretches))), float(max(map(np.max, stretches)))),
            modes=[mode for mode in LODE if mode in {_MODES[kind] for kind in kinds}],
            largest=max(float(np.abs(strain).max()) for strain in strains),
            rates=(float(min(map(np.median, rates))), float(max(map(np.median, rates))))
            if rates
            else None,
            columns=fit.law,
            covariance=covariance,
        )


@dataclass(frozen=True)
class _System:
    """Weighted residuals of a class of laws, and their derivatives
    by scaled coefficients and machines' constants.
    """

    search: _Search
    tests: Sequence[MaterialTest]
    names: tuple[str, ...]
    of_machines: Sequence[tuple[int, str]]  # test and constant
    scales: FloatArray
    rows: Sequence[BoolArray] | None

    def unpacked(
        self, x: FloatArray
    ) -> tuple[dict[str, float], dict[str, float], list[dict[str, float]]]:
        """Returns the coefficients, the whole law, and the constants of the machines."""
        values, count = (x * self.scales).tolist(), len(self.names)
        coefficients = dict(zip(self.names, values[:count], strict=True))
        machines: list[dict[str, float]] = [{} for _ in self.tests]
        for (number, name), value in zip(self.of_machines, values[count:], strict=True):
            machines[number][name] = value
        law, viscous = dict(coefficients), self.search.viscous
        for name, value in viscous.items():
            law[name] = law.get(name, 0.0) + value
        return (
            coefficients,
            law | {"bulk_1": bulk_of(coefficients, self.search.poissons_ratio)},
            machines,
        )

    def linear(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns residuals (R,) and derivatives (R, P) by x (P,)."""
        _, law, machines = self.unpacked(x)
        residuals, slopes = list[FloatArray](), list[FloatArray]()
        for number, (test, machine) in enumerate(zip(self.tests, machines, strict=True)):
            value, by_law, by_strain = test.response(test.taut(machine), law)
            zero = np.zeros_like(value)
            by_machine = {
                "zero": zero + 1.0,
                "toe": -by_strain,
                "compliance": -by_strain * test.stress,
            }
            columns = [by_law[name] for name in self.names]
            columns += [by_machine[name] if at == number else zero for at, name in self.of_machines]
            chosen = test.used if self.rows is None else self.rows[number]
            weights = (test.weights * math.sqrt(min(SAMPLES / chosen.sum(), 1.0)) / NOISE)[chosen]
            residuals.append((value + machine.get("zero", 0.0) - test.stress)[chosen] * weights)
            slopes.append(np.stack(columns, 1)[chosen] * weights[:, None] * self.scales)
        residuals.append(x[len(self.names) :])
        slopes.append(np.eye(len(x))[len(self.names) :])
        known = self.search.known
        if known is not None:
            shares = np.array(
                [shear_modulus({name: 1.0}) for name in self.names] + [0.0] * len(self.of_machines)
            )
            modulus = shear_modulus(known["parameters"])
            deviation = known.get("shear_deviation") or _RELATIVE_DEVIATION * modulus
            row = shares * self.scales / deviation
            residuals.append(np.array([row @ x - modulus / deviation]))
            slopes.append(row[None])
        return np.concatenate(residuals), np.concatenate(slopes)

    def fit(self, x: FloatArray, residual: FloatArray, slopes: FloatArray) -> _Fit:
        """Returns the fit at the minimum, with the covariance of coefficients that are not zero."""
        count, free = len(self.names), x > 1e-12
        free[len(self.names) :] = True
        curvature = slopes[:, free].T @ slopes[:, free]
        samples = sum(min(SAMPLES, int(test.used.sum())) for test in self.tests)
        variance = max(float(residual @ residual) / max(samples - free.sum(), 1), 1.0)
        whole = np.zeros((len(x), len(x)))
        whole[np.ix_(free, free)] = variance * np.linalg.pinv(curvature)
        coefficients, law, machines = self.unpacked(x)
        covariance = whole[:count, :count] * np.outer(self.scales[:count], self.scales[:count])
        return _Fit(self.tests, coefficients, law, machines, covariance)
