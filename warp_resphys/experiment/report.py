"""Stage: the report page."""

from ..io.files import write_text
from ..io.stages import StageContext
from .files import REPORT


def make_report(context: StageContext) -> None:
    """Writes report.html."""
    write_text(context.run_dir / REPORT, "-")


def make_folds_report(context: StageContext) -> None:
    """Writes report.html over the folds."""
    write_text(context.run_dir / REPORT, "-")
