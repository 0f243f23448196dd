"""Names of identified parameters, as a reader sees them."""

import pytest

from warp_resphys.report.identification_section import parameter_wording


@pytest.mark.parametrize(
    ("parameter", "name", "unit", "shown"),
    [
        ("pressure_slew", "Reciprocal of the slew rate of the pressures", "µs per unit", 2.0),
        ("tendon_contraction_dead_band", "Dead band of the contractions", "mm", 2e-3),
        ("muscle_contraction_dead_band", "Dead band of the contractions", "%", 2e-4),
        ("pressure_slope_3", "Slope 3 of the characteristic of the pressures", "", 2e-6),
        ("tendon_tension_delay", "Delay of the tensions", "ms", 2e-3),
        ("muscle_stress_factor", "Factor of the stresses", "", 2e-6),
        ("prony_time_1", "Relaxation time 1", "s", 2e-6),
    ],
)
def test_parameters_of_actuators_have_words_and_units(parameter, name, unit, shown):
    words, of, factor = parameter_wording(parameter)
    assert (words, of) == (name, unit)
    assert 2e-6 * factor == pytest.approx(shown)
