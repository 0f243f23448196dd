"""The public names of the package; those of the simulator alone are imported without the others."""

from .core.public import *  # noqa: F403
from .data.force_sensors import ForceSensor as ForceSensor
from .data.markers import Markers as Markers
from .data.markers import Observation as Observation
from .data.markers import bind_markers as bind_markers
from .data.recordings.recording_files import read_recording as read_recording
from .learning.evaluation import evaluate as evaluate
from .learning.identification.identification import identify as identify
from .learning.identification.law_search import identify_law as identify_law
from .learning.observed_motions import ObservedMotions as ObservedMotions
from .learning.residuals.actuator_fit import fit_actuator as fit_actuator
from .learning.residuals.fitting import fit_force as fit_force
from .learning.residuals.reconstruction import reconstruct as reconstruct
from .report.motion_film import film as film
from .robot.loading import load as load
from .robot.loading import recorded_trial as recorded_trial
from .robot.loading import trial_names as trial_names
from .robot.robot import Robot as Robot
from .robot.robot_scene import RobotScene as RobotScene
from .twin.twin import Twin as Twin
