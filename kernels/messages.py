"""Messages of Warp, without those that a user of this package does not need."""

import sys
import warnings

import warp as wp


class QuietLogger:
    """A logger of Warp, for the whole process, that leaves out its greeting and the loading of modules of this package.

    Kernels that are compiled are named, as that takes seconds. ``wp.config.log_level = wp.LOG_DEBUG`` shows everything,
    and `wp.set_logger(None)` brings back Warp's own logger.
    """

    def debug(self, message: str) -> None:
        """Prints details of compilation."""
        sys.stdout.write(f"{message}\n")

    def info(self, message: str) -> None:
        """Prints a message, unless it is a greeting or says that a module of this package was in the cache."""
        known = message.startswith(f"Module {__package__}.") and "(cached)" in message
        if wp.config.log_level <= wp.LOG_DEBUG or not (known or message.startswith("Warp ")):
            sys.stdout.write(f"{message}\n")

    def warning(self, message: str, category: type[Warning] | None = None, stacklevel: int = 1) -> None:
        """Issues a warning."""
        warnings.warn(message, category or UserWarning, stacklevel=stacklevel)

    def error(self, message: str) -> None:
        """Prints an error."""
        sys.stderr.write(f"Warp: {message}\n")
