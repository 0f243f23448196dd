"""A module that needs an extra says which one to install, to programs that catch either error."""

import runpy
import sys

import pytest

from warp_resphys.io.errors import InputError


@pytest.mark.parametrize(
    ("package", "module", "extra"),
    [
        ("gymnasium", "environments.vector", "environments"),
        ("gymnasium", "environments.making", "environments"),
        ("gymnasium", "environments.policies", "environments"),
        ("stable_baselines3", "environments.stable_baselines", "policies"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_a_module_without_its_extra(monkeypatch, package, module, extra):
    for name in [name for name in sys.modules if name.startswith("warp_resphys.environments")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"pip install 'warp-resphys\[{extra}\]'") as told:
        runpy.run_module(f"warp_resphys.{module}")
    assert isinstance(told.value, InputError)
