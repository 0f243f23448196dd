"""Names of the files in a run folder, and what acts during the trials of a dataset."""

from pathlib import Path
from typing import Any, Final

from ..io.safe_files import read_json

DATASET: Final = "dataset.h5"
SCALED_DATASET: Final = "dataset_scaled.h5"
TRUTH: Final = "truth.json"
QUALITY: Final = "quality.json"
REGISTRATION: Final = "registration.json"
IDENTIFICATION: Final = "identification.json"
LAW_FILE: Final = "law.json"
ACTUATOR_FILE: Final = "actuator.json"
SHAPES: Final = "shapes.json"
RECONSTRUCTION: Final = "reconstruction.json"
ROLLOUTS: Final = "rollouts.h5"
ERRORS: Final = "errors.json"
TIMES: Final = "times.json"
MESH_CHECK: Final = "mesh_check.json"
CONTROL: Final = "control.json"
DRIVEN: Final = "driven.h5"
# Prefixes of the names of controllers; the rest of a name is the planning model or the gain.
OPEN: Final = "open_"
RECEDING: Final = "receding_"
LINEAR: Final = "linear"
FEEDBACK: Final = "feedback_"
METRICS: Final = "metrics.json"
COMPARE: Final = "compare"  # stage of runs with pictures
REPORT: Final = "report.html"


def reconstruction_file(model: str) -> str:
    """File of the states and residual forces reconstructed with a model's simulator."""
    return f"reconstruction_{model}.h5"


def weights_file(model: str) -> str:
    """File of a model's trained weights."""
    return f"{model}.safetensors"


def training_file(model: str) -> str:
    """File of a model's training history."""
    return f"training_{model}.json"


def fold_folder(trial: str) -> str:
    """Subfolder of the fold that is tested on a trial."""
    return f"fold_{trial}"


def read_if_there(path: Path) -> Any:
    """Contents of a JSON file, or an empty dictionary if the file does not exist."""
    return read_json(path) if path.is_file() else {}
