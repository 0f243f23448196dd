"""The marker ablation through its command line, with a small beam and few steps."""

import contextlib
import csv
import json
import signal
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from support.configured import check, composed
from support.main_job import run
from warp_resphys import box_hexahedra, select_vertices
from warp_resphys.experiment import ablation
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_hdf5
from warp_resphys.mesh.mesh import surface_vertices
from warp_resphys.report.ablation_page import verdict

COUNTS = [1, 4, 33, 42]
TINY = [
    "experiment=marker_ablation",
    "mesh.divisions=[4,2,2]",
    "data.steps=8",
    f"ablation.counts={COUNTS}".replace(" ", ""),
    "ablation.draws=5",
    "ablation.processes=1",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
    "hydra.run.dir=run",
]
SURFACE = surface_vertices(box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)))
CLAMPED = select_vertices(box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)), x=0.0)


def rows(folder="run"):
    return json.loads((Path(folder) / "metrics.json").read_text())["by_markers"]


def errors(folder="run"):
    return np.array([row["errors_mm"] for row in rows(folder)])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("ablation")
    with contextlib.chdir(root):
        assert run(*TINY)[0] == 0
    return root / "run"


def test_more_markers_leave_less_error_and_spread(finished):
    results = json.loads((finished / "metrics.json").read_text())
    assert results["uncorrected_mm"] > 0.3
    medians = [row["median_mm"] for row in rows(finished)]
    assert np.diff(medians).max() <= 1e-9 * medians[0]  # The last count only adds markers that cannot move.
    assert medians[1] < 0.2 * results["uncorrected_mm"]
    assert rows(finished)[2]["interquartile_range_mm"] < 0.1 * rows(finished)[0]["interquartile_range_mm"]
    assert list(results["seconds"]) == ["generate", "ablation", "report"]


def test_sets_are_of_free_surface_vertices_unless_these_are_too_few(finished):
    with read_hdf5(finished / "ablation.h5", "marker ablation") as file:
        sets = file["markers"][:]
        assert file["error"].attrs["units"] == "m"
        assert file["count"][:].tolist() == COUNTS
    assert sets.shape == (4, 5, 42)
    assert len(SURFACE) - len(CLAMPED) == 33
    for count, draws in zip(COUNTS, sets, strict=True):
        assert (draws[:, count:] == -1).all()
        chosen = [frozenset(row[:count].tolist()) for row in draws]
        assert all(len(markers) == count for markers in chosen)
        assert all(markers <= set(SURFACE) - (set(CLAMPED) if count <= 33 else set()) for markers in chosen)
    assert len({frozenset(row[:4].tolist()) for row in sets[1]}) > 1


def test_the_table_is_that_of_the_stored_distances(finished):
    with read_hdf5(finished / "ablation.h5", "marker ablation") as file:
        mean = 1e3 * file["error"][:].mean(-1)
    np.testing.assert_allclose(errors(finished), mean)
    with (finished / "ablation.csv").open() as file:
        table = [(int(r["markers"]), int(r["draw"]), float(r["error_mm"])) for r in csv.DictReader(file)]
    assert [t[:2] for t in table] == [(count, draw) for count in COUNTS for draw in range(5)]
    np.testing.assert_allclose([t[2] for t in table], mean.ravel(), rtol=1e-8)
    row = rows(finished)[0]
    assert row["median_mm"] == pytest.approx(np.median(mean[0]))
    assert row["interquartile_range_mm"] == pytest.approx(np.subtract(*np.quantile(mean[0], [0.75, 0.25])))


@pytest.mark.slow
def test_an_interrupted_run_goes_on_and_a_set_does_not_depend_on_the_other_counts(finished, folder, monkeypatch):
    step = ablation._FromMarkers.step

    def interrupted(march, number):
        if (march._count, number) == (1, 3):
            signal.raise_signal(signal.SIGINT)
        return step(march, number)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with monkeypatch.context() as patch:
        patch.setattr(ablation._FromMarkers, "step", interrupted)
        assert run(*TINY)[0] == 130
    signal.signal(signal.SIGINT, before)
    reconstructed = Counter()

    def counted(march, number):
        reconstructed[march._count] += 1
        return step(march, number)

    monkeypatch.setattr(ablation._FromMarkers, "step", counted)
    assert run(*TINY)[0] == 0
    assert reconstructed == {1: 8}  # The largest sets come first, and are kept.
    np.testing.assert_allclose(errors(), errors(finished), rtol=1e-6)
    assert run(*TINY)[0] == 0
    assert reconstructed.total() == 8
    assert run(*TINY, "ablation.counts=[4]")[0] == 0
    np.testing.assert_allclose(errors(), errors(finished)[1:2], rtol=1e-6)
    assert run(*TINY, "ablation.counts=[4]", "seed=1")[0] == 0
    assert np.abs(errors() / errors(finished)[1:2] - 1.0).max() > 0.01


@pytest.mark.slow
def test_processes_give_the_same_numbers_in_the_same_order_and_do_not_count_as_a_change(finished, folder):
    assert run(*TINY, "ablation.processes=2")[0] == 0
    assert rows() == rows(finished)
    with (
        read_hdf5("run/ablation.h5", "marker ablation") as file,
        read_hdf5(finished / "ablation.h5", "marker ablation") as serial,
    ):
        for name in ("count", "markers", "error", "misfit"):
            np.testing.assert_array_equal(file[name][:], serial[name][:])
    written = Path("run/ablation.h5").stat().st_mtime_ns
    assert run(*TINY, "ablation.processes=3")[0] == 0
    assert Path("run/ablation.h5").stat().st_mtime_ns == written


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        ("ablation.counts=[1,43]", "ablation.counts"),
        ("ablation.counts=[2,2]", "ablation.counts"),
        ("ablation.modes=1000", "1000 vibration modes were asked for, but the body has 1 to 108."),
        ("data.weights_g.observed=[50,70]", "data.weights_g.observed"),
        ("reconstruction=lbfgsb ablation.modes=4", "reconstruction.method"),
    ],
)
def test_bad_input(overrides, key):
    with pytest.raises(InputError) as told:
        check(composed(*TINY, *overrides.split()))
    assert key in str(told.value)


def test_verdict_looks_from_the_largest_number_of_markers_down():
    def row(markers, median, spread):
        return {"markers": markers, "median_mm": median, "interquartile_range_mm": spread}

    said = verdict([row(1, 0.05, 0.2), row(2, 0.2, 0.04), row(4, 0.09, 0.06), row(8, 0.02, 0.01)], 1.0)
    assert said.startswith("With 4 or more markers, the median error stays below 0.1\N{NO-BREAK SPACE}mm")
    assert said.endswith("With 8 or more, the quartiles are less than 0.05\N{NO-BREAK SPACE}mm apart.")
    assert verdict([row(1, 0.2, 0.2)], 1.0).startswith("With none of these")
