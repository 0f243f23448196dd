"""A soft block in contact beside other simulators."""

import importlib.util

import numpy as np
import pytest

from support.command_line import outcome, refusal, settings_of
from warp_resphys.io.files import read_json
from warp_resphys.studies.peer_contact import PeerContactStudy, PeerScene

SMALL = ["divisions=[4,3,2]", "repeats=1", "duration=0.22"]
REFERENCE = "reference={time_step: 0.001, distance: 1e-5, tolerance: 1e-8}"
BARRIER = (
    "barrier=[{time_step: 4e-3, distance: 1e-3, tolerance: 1e-4}, {time_step: 1e-3, distance: 1e-4, tolerance: 1e-4}]"
)
VBD = "vbd=[{time_step: 1e-3, stiffness: 1e4, damping: 0.0, iterations: 20}]"
FLEX = "flex=[{time_step: 1e-3, solver: CG, tolerance: 1e-6, time_constant: 1e-3, impedance: 0.99}]"


def rows(folder, peers):
    said = outcome("benchmark", "peers-contact", *SMALL, REFERENCE, BARRIER, VBD, FLEX, f"peers={peers}").out
    assert "ours at that error" in said
    (written,) = folder.rglob("peers_contact.json")
    return read_json(written)["found"]


def test_ours_approaches_coulombs_law_and_rigid_walls(folder):
    measured = rows(folder, "[]")
    for name, most in (("slide", 1.0), ("grip", 0.2)):
        coarse, fine = measured[name]
        assert fine["error_mm"] < min(0.4 * coarse["error_mm"], most), name
        assert coarse["penetration_um"] == fine["penetration_um"] == 0.0
        assert coarse["load"] == pytest.approx(coarse["ms"] / 4.0)


def test_a_block_begins_where_contact_does():
    study = settings_of(PeerContactStudy, "benchmark_peers_contact", "squeeze=0.25")
    for scene, faces in ((PeerScene.slide(study), 1), (PeerScene.grip(study), 2)):
        gaps = scene.gaps(scene.start(1e-3))
        nearest = np.isclose(gaps, 1e-3, rtol=0.0, atol=1e-12)
        across = study.mesh.vertices[:, 2 if faces == 1 else 1]
        assert gaps.min() > 1e-3 - 1e-12
        assert nearest.sum() == faces * (across == 0.0).sum()
    narrow = np.ptp(PeerScene.grip(study).start(0.0), axis=0) / study.size
    assert narrow == pytest.approx([1.0 + 0.45 * 0.25, 0.75, 1.0 + 0.45 * 0.25])


@pytest.mark.parametrize("peer", ["newton", "mujoco"])
def test_a_peer_comes_to_the_same(folder, peer):
    pytest.importorskip(peer)
    measured = rows(folder, f"[{peer}]")
    for name, most in (("slide", 3.0), ("grip", 0.1)):
        last = measured[name][-1]
        assert last["solver"] == peer
        assert last["error_mm"] < most
        assert last["penetration_um"] > 0.0


@pytest.mark.parametrize("peer", ["newton", "mujoco", "mujoco_warp"])
def test_without_a_peer(folder, peer):
    if importlib.util.find_spec(peer):
        pytest.skip("it is installed")
    said = outcome("benchmark", "peers-contact", f"peers=[{peer}]").err
    assert f"The package {peer} is not installed: run pip install 'warp-resphys[peer]'." in said


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("peers=[bullet]", "peers is ['bullet']: it must be a list of newton, mujoco, mujoco_warp."),
        ("barrier=[]", "barrier is []"),
        ("flex=[{time_step: 1e-3, solver: PGS}]", "flex[0].solver is 'PGS'"),
        ("squeeze=0", "squeeze is 0"),
    ],
)
def test_bad_settings(folder, override, key):
    assert key in refusal("benchmark", "peers-contact", override)
