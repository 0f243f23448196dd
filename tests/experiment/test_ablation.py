"""The marker ablation through its command line, with a small beam and few steps."""

import contextlib

import numpy as np
import pytest

from support.main_job import finish
from warp_resphys import box_hexahedra, select_vertices
from warp_resphys.core.mesh.volume_mesh import surface_vertices
from warp_resphys.io.safe_files import read_hdf5, read_json
from warp_resphys.report.pages.ablation_page import MarkerErrors, verdict

COUNTS = [1, 4, 33, 42]
TINY = [
    *("experiment=marker_ablation", "mesh.divisions=[4,2,2]", "data.steps=8", "ablation.draws=5"),
    *(f"ablation.counts={COUNTS}".replace(" ", ""), "ablation.processes=1"),
]
BEAM = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
SURFACE, CLAMPED = surface_vertices(BEAM), select_vertices(BEAM, x=0.0)


def rows(folder):
    return read_json(folder / "metrics.json")["by_markers"]


def errors(folder):
    return np.array([row["errors_mm"] for row in rows(folder)])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("ablation")
    with contextlib.chdir(root):
        return root / finish(*TINY)


def test_more_markers_leave_less_error_and_spread_in_the_table_of_the_stored_distances(finished):
    results = read_json(finished / "metrics.json")
    assert results["uncorrected_mm"] > 0.3
    medians = [row["median_mm"] for row in rows(finished)]
    # The last count only adds markers that cannot move.
    assert np.diff(medians).max() <= 1e-9 * medians[0]
    assert medians[1] < 0.2 * results["uncorrected_mm"]
    assert (
        rows(finished)[2]["interquartile_range_mm"]
        < 0.1 * rows(finished)[0]["interquartile_range_mm"]
    )
    assert list(results["seconds"]) == ["generate", "ablation", "report"]
    with read_hdf5(finished / "ablation.h5", "marker ablation") as file:
        mean = 1e3 * file["error"][:].mean(-1)
    np.testing.assert_allclose(errors(finished), mean)
    row = rows(finished)[0]
    assert row["median_mm"] == pytest.approx(np.median(mean[0]))
    assert row["interquartile_range_mm"] == pytest.approx(
        np.subtract(*np.quantile(mean[0], [0.75, 0.25]))
    )


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
        assert all(
            markers <= set(SURFACE) - (set(CLAMPED) if count <= 33 else set()) for markers in chosen
        )
    assert len({frozenset(row[:4].tolist()) for row in sets[1]}) > 1


@pytest.mark.slow
def test_a_set_depends_on_the_seed_and_neither_on_the_other_counts_nor_on_processes(
    finished, folder
):
    assert rows(finish(*TINY, "ablation.processes=2")) == rows(finished)
    written = (folder / "run" / "ablation.h5").stat().st_mtime_ns
    assert (finish(*TINY, "ablation.processes=3") / "ablation.h5").stat().st_mtime_ns == written
    np.testing.assert_allclose(
        errors(finish(*TINY, "ablation.counts=[4]")), errors(finished)[1:2], rtol=1e-6
    )
    other = errors(finish(*TINY, "ablation.counts=[4]", "seed=1"))
    assert np.abs(other / errors(finished)[1:2] - 1.0).max() > 0.01


def test_verdict_looks_from_the_largest_number_of_markers_down():
    def row(markers, median, spread):
        return MarkerErrors(markers, median, 0.0, 0.0, spread, 0.0, 0.0, ())

    said = verdict(
        [row(1, 0.05, 0.2), row(2, 0.2, 0.04), row(4, 0.09, 0.06), row(8, 0.02, 0.01)], 1.0
    )
    assert said.startswith(
        "With 4 or more markers, the median error stays below 0.1\N{NO-BREAK SPACE}mm"
    )
    assert said.endswith(
        "With 8 or more, the quartiles are less than 0.05\N{NO-BREAK SPACE}mm apart."
    )
    assert verdict([row(1, 0.2, 0.2)], 1.0).startswith("With none of these")
