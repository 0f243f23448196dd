"""Stage: identifies the law of the material from the training trials, and accepts it if it helps on validation trials.

A law of another run stays as it is; the parameters of actuators and of the medium are identified with it.
"""

from ..energies.catalogue import read_law
from ..io.parts import Checkpoint
from ..io.resuming import StageContext, package_versions
from ..io.safe_files import write_json
from ..learning import law_search
from ..settings.stage_keys import StageSettings
from .experiment import Experiment
from .files import LAW_FILE


def identify_law(context: StageContext) -> None:
    """Writes law.json: the law, its posterior, the classes that were tried, and whether it is used.

    A run that is interrupted keeps the classes of the weak form and the finished searches.

    Raises:
        DataFileError: the file of the law is missing, damaged or of another version.
    """
    settings: StageSettings = context.settings
    experiment, kept, file = Experiment(settings, context.run_dir, "count"), Checkpoint(context), settings.law.file
    known = None if file is None else read_law(file)
    law = law_search.identify_law(
        *(experiment.simulator("identified"), experiment.motions),
        {} if settings.identified is None else settings.identify.parameters,
        identified=experiment.identified("sysid"),
        train=settings.split.train,
        validation=settings.split.validation,
        settings=settings.law,
        seconds=settings.trial_seconds,
        known=known,
        once=kept.once,
        title=context.name,
    )
    content = law.plain()
    if known is None:
        content["data"], content["versions"] = {"name": settings.name, "trials": law.trials}, package_versions()
    else:
        accepted = known.get("accepted_there", known.get("accepted", True))
        content = {**known, **content, "accepted_there": accepted, "file": file}
    write_json(context.run_dir / LAW_FILE, content)
    kept.path.unlink(missing_ok=True)
