"""Identification as a function, without configuration or run folder. `tests/learning/test_library.py`."""

from collections.abc import Mapping

from ..dynamics.simulator import Simulator
from .identification import Identification, ParameterSearch
from .misfit import Misfit
from .observed_motions import ObservedMotions
from .parameters import Bounds, configured_parameters


def identify(
    simulator: Simulator,
    motions: ObservedMotions,
    parameters: Mapping[str, Bounds | tuple[float, float]],
    first_guess: Mapping[str, float] | None = None,
    *,
    starts: int = 1,
    max_evaluations: int = 30,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> Identification:
    """Finds the parameters with which a simulator comes closest to observed motions.

    Args:
        simulator: gives all other parameters.
        motions: observed states or markers.
        parameters: range of every parameter to identify, by a name of `Replay.parameter_names`, in its unit. A pair of
            positive numbers is searched on a logarithmic scale.
        first_guess: start of the search; the simulator's own values where left out.
        starts: number of searches; those after the first start at the best of four times as many random candidates.
        max_evaluations: of the loss and its gradient, for each start.
        tolerance: relative decrease of the loss below which a search ends.
        seed: of the random candidates.

    Returns:
        The parameters, the loss, its history, parameters that ended on a bound, and the uncertainty.

    Raises:
        InputError: an unknown parameter, an empty range, or a motion in which nothing moves.
        ConvergenceError: the simulation fails at every start.
    """
    ranges = {n: b if isinstance(b, Bounds) else Bounds(*b, logarithmic=min(b) > 0.0) for n, b in parameters.items()}
    search = ParameterSearch(Misfit(motions.replays(simulator), ranges))
    guess = {**configured_parameters(simulator, ranges), **(first_guess or {})}
    return search.run(search.starts(guess, starts, 4 * starts, seed), max_evaluations, tolerance=tolerance)
