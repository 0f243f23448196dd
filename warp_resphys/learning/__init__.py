"""Identification of parameters, reconstruction of residual forces,
and networks that predict these forces.
"""

from ..settings.learning import Bounds as Bounds
from ..settings.learning import Prior as Prior
from .evaluation import evaluate as evaluate
from .identification.identification import identify as identify
from .identification.law_search import identify_law as identify_law
from .identification.material_tests import identify_from_tests as identify_from_tests
from .identification.membranes import Membrane as Membrane
from .identification.scaling import scale_to_tests as scale_to_tests
from .identification.search import Identification as Identification
from .identification.search import search_parameters as search_parameters
from .identification.specimens import MaterialTest as MaterialTest
from .identification.specimens import Specimen as Specimen
from .observed_motions import ObservedMotions as ObservedMotions
from .residuals.actuator_fit import fit_actuator as fit_actuator
from .residuals.fitting import fit_force as fit_force
from .residuals.reconstruction import reconstruct as reconstruct
