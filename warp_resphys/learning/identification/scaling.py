"""A known law, scaled by one factor to tests of another batch.

Batches of one silicone differ in stiffness by mixing, cure and age, much more than in the shape of
their curves. The factor minimises the relative errors of the tests, by Gauss-Newton in its
logarithm.
"""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from ...core.energies.catalogue import LawContent, modes_of
from ...core.energies.isochoric import TERMS, bulk_of
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError, InputError
from .material_tests import NOISE, SAMPLES, MeasuredLaw
from .specimens import MaterialTest

_STIFF: Final = (
    3.0  # factor to start from: a stiff membrane has an equilibrium, a soft one may burst
)
_HALVINGS: Final = 5  # of a step that does not lower the residuals
_MOST: Final = 0.7  # step of the logarithm
_TOLERANCE: Final = 1e-3  # its last change

# Residuals and derivatives (R,) by the logarithm of the factor.
Linear = tuple[FloatArray, FloatArray]


def scale_to_tests(
    tests: Mapping[str, MaterialTest],
    known: LawContent,
    *,
    density: float,
    poissons_ratio: float = 0.4995,
) -> MeasuredLaw:
    """Returns a known law whose coefficients are all multiplied by the factor that fits tests best.

    Args:
        tests: tests by name, without constants of a machine.
        known: law of another batch of the material, without viscosity and branches.
        density: of the material [kg/m^3].
        poissons_ratio: of the material at small strains.

    Raises:
        InputError: no test, a test with constants of a machine or with a shear modulus that no
            elastomer has, or a law with branches or without elastic terms.
        ConvergenceError: a simulated specimen has no equilibrium.
    """
    law = {
        name: value
        for name, value in known["parameters"].items()
        if TERMS.fullmatch(name) and value
    }
    if not tests:
        raise InputError("tests is empty: a law is scaled to one test or more.")
    if not law or any(name.startswith(("prony", "shear_visc")) for name in known["parameters"]):
        raise InputError(
            "a law to be scaled has elastic terms alone, such as c10: take one without branches."
        )
    machines = [name for name, test in tests.items() if test.deviations]
    if machines:
        raise InputError(
            f"{machines[0]} has an unknown machine: set its zero, "
            "toe and compliance to 0 to scale a law."
        )
    for name, test in tests.items():
        test.check(name)

    def columns(x: float) -> dict[str, float]:
        scaled = {name: value * math.exp(x) for name, value in law.items()}
        return {**scaled, "bulk_1": bulk_of(scaled, poissons_ratio)}

    def linear(x: float) -> Linear:
        residuals = list[FloatArray]()
        slopes = list[FloatArray]()
        found = columns(x)
        for test in tests.values():
            value, by_law, _ = test.response(test.strain, found)
            weights = test.weights * math.sqrt(min(SAMPLES / test.used.sum(), 1.0)) / NOISE
            weights = weights[test.used]
            residuals.append((value - test.stress)[test.used] * weights)
            slopes.append(
                np.sum([found[name] * by_law[name] for name in law], axis=0)[test.used] * weights
            )
        return np.concatenate(residuals), np.concatenate(slopes)

    x, step = math.log(_STIFF), math.inf
    now = linear(x)
    while abs(step) > _TOLERANCE:
        residual, slope = now
        step = float(np.clip(-(slope @ residual) / (slope @ slope), -_MOST, _MOST))
        for _ in range(_HALVINGS):
            try:
                new = linear(x + step)
            except ConvergenceError:  # The specimen is too soft.
                new = None
            if new is not None and float(new[0] @ new[0]) <= float(residual @ residual) * (
                1.0 + 1e-9
            ):
                x, now = x + step, new
                break
            step *= 0.5
        else:
            break
    return _scaled(tests, law, columns(x), now, density, known)


def _scaled(
    tests: Mapping[str, MaterialTest],
    law: Mapping[str, float],
    columns: dict[str, float],
    found: Linear,
    density: float,
    known: LawContent,
) -> MeasuredLaw:
    """Returns the law at the minimum; its coefficients share one relative standard deviation."""
    residual, slope = found
    samples = sum(min(SAMPLES, int(test.used.sum())) for test in tests.values())
    relative = max(float(residual @ residual) / samples, 1.0) / float(slope @ slope)
    values = np.array([columns[name] for name in law])
    errors = {
        n: math.sqrt(float(np.square(t.away(columns, {})[t.used]).mean())) for n, t in tests.items()
    }
    parameters = {"density": density, **{name: columns[name] for name in (*law, "bulk_1")}}
    groups = [name for name in law if name != "c10"]
    low, high = known.get("stretches", (1.0, 1.0))
    return MeasuredLaw(
        parameters=parameters,
        deviation=dict(zip(law, (math.sqrt(relative) * values).tolist(), strict=True)),
        machines={name: {} for name in tests},
        errors=errors,
        classes=[],
        groups=groups,
        stretches=(low, high),
        modes=modes_of(known),
        largest=max(float(np.abs(test.strain[test.used]).max()) for test in tests.values()),
        rates=None,
        columns=columns,
        covariance=relative * np.outer(values, values),
    )
