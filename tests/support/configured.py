"""Configurations of runs, as the command line composes them."""

import copy
import functools

import warp_resphys.overrides
from warp_resphys.experiment.checks import check_run
from warp_resphys.io.settings import parse
from warp_resphys.settings.run import RunSettings


@functools.cache
def _composed(*overrides):
    return parse(RunSettings, warp_resphys.overrides.composed("config", overrides)).plain()


def composed(*overrides):
    """Nested plain settings with all defaults."""
    own = [
        word
        for word in overrides
        if not word.startswith("hydra") or word.startswith("hydra.searchpath")
    ]
    return copy.deepcopy(_composed(*own))


def settings(*overrides):
    """Settings of a run."""
    return parse(RunSettings, composed(*overrides))


def check(config):
    """Checks a configuration as a run would."""
    check_run(parse(RunSettings, config))
