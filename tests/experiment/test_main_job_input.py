"""The main job with settings, meshes, files and disks that it cannot use: one sentence, exit code 2."""

import re
from pathlib import Path

import meshio
import numpy as np
import pytest

from support.configured import check, composed
from support.main_job import IN_RUN, SHORT, STAGES, TINY, errors, files, ran, run, same_errors
from warp_resphys import box_hexahedra
from warp_resphys.io.errors import ResphysError

resource = pytest.importorskip("resource", reason="this system cannot limit a process")


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        ("simulation.poissons_ratio=0.5", "simulation: poissons_ratio is"),
        ("+simulation.stiffness=5", "'stiffness'"),
        ("simulation.youngs_modulus=soft", "simulation.youngs_modulus"),
        ("simulation.density=1e30", "the mesh is"),
        ("+in_the_loop={start:network}", "in_the_loop.start"),
        ("network.width=16000 network.layers=90 network.blocks=90", "network.width, layers and blocks make"),
        ("integrator=rk4", "integrator is"),
        ("fixed=null", "fixed is null, and obstacles has none that the body lies on"),
        ("tip={x:9}", "no vertex lies within 1e-09 m of x = 9 m"),
        ("mesh.divisions=[10000,10000,1000]", "mesh.divisions"),
        ("data.weights_g.validation=[]", "data.weights_g.validation is empty"),
        ("data.weights_g.test=[90]", "data.weights_g"),
        ("data.kind=drop", "data.kind"),
    ],
)
def test_settings_that_cannot_work_are_named(overrides, key):
    with pytest.raises(ResphysError) as told:
        check(composed(*TINY, *overrides.split(" ")))
    assert key in str(told.value)
    assert "\n" not in str(told.value)


class TestCommand:
    @pytest.mark.parametrize(
        ("overrides", "key"),
        [
            ("trainer.epoch=5", "'trainer.epoch'"),
            ("time_step=0", "time_step is"),
            ("solver.max_iterations=1", "the newton solver stopped after 1 iterations"),
        ],
    )
    def test_settings(self, folder, overrides, key):
        self.check(*run(*TINY, IN_RUN, *overrides.split(" ")), key)

    @pytest.mark.parametrize("content", [None, "truncated", "surface"])
    def test_mesh(self, folder, content):
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        if content is not None:
            faces = [("quad", box.cells[:, :4])] if content == "surface" else [("hexahedron", box.cells)]
            meshio.write("box.vtu", meshio.Mesh(box.vertices, faces))
        if content == "truncated":
            Path("box.vtu").write_bytes(Path("box.vtu").read_bytes()[:-300])
        self.check(*run(*SHORT, IN_RUN, "mesh=file", "mesh.path=box.vtu"), "box.vtu: ")

    def test_mesh_without_path(self, folder):
        self.check(*run(*SHORT, IN_RUN, "mesh=file"), "Missing mandatory value: path (at mesh.path)")

    @staticmethod
    def check(code, err, key):
        lines = [line for line in err.splitlines() if not line.startswith(tuple(f"{stage}: " for stage in STAGES))]
        assert (code, len(lines)) == (2, 1)
        assert lines[0].startswith("error: ")
        assert key in lines[0]
        written = {path.name for path in Path("run").rglob("*") if path.is_file()} if Path("run").exists() else set()
        assert not written & {"metrics.json", "report.html", "resphys.safetensors", "rollouts.h5"}
        assert not [name for name in written if name.endswith(".partial")]


@pytest.mark.slow
class TestFiles:
    def test_a_file_mesh_runs(self, folder, no_report, finished):
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        meshio.write("box.vtu", meshio.Mesh(100.0 * box.vertices, [("hexahedron", box.cells)]))
        tolerance = ["+fixed.tolerance=1e-6", "+data.load.tolerance=1e-6"]
        arguments = [*SHORT, IN_RUN, "mesh=file", "mesh.path=box.vtu", "mesh.units=cm", *tolerance]
        assert run(*arguments)[0] == 0
        np.testing.assert_allclose(errors()[:2], errors(finished[0])[:2], rtol=0.05)
        before = files()
        box = box_hexahedra((0.1, 0.03, 0.03), (3, 2, 2))
        meshio.write("box.vtu", meshio.Mesh(100.0 * box.vertices, [("hexahedron", box.cells)]))
        assert run(*arguments)[0] == 0
        assert ran(before) == STAGES  # the file's content counts, not its name

    def test_a_damaged_dataset_is_made_again(self, finished, copied, no_report, caplog):
        path = Path("run/dataset.h5")
        path.write_bytes(path.read_bytes()[:-1000])
        assert run(*TINY, IN_RUN)[0] == 0
        assert "simulate: missing or changed since they were written: dataset.h5" in caplog.text
        assert ran(copied) == ["simulate"]  # the same forces as before: what follows is still valid
        same_errors(errors(), errors(finished[0]))

    @staticmethod
    def run_with_files_up_to(kilobytes):
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000 * kilobytes, limits[1]))
        try:
            return run(*TINY, IN_RUN)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    def test_full_disk(self, finished, folder, no_report):
        code, err = self.run_with_files_up_to(230)
        full = f"{folder}/run/reconstruct_resphys_parts/part0_000.h5"
        assert code == 2
        assert err.splitlines()[-1].startswith(f"error: disk is full while writing {full}: free some space and run the")
        assert not Path("run/metrics.json").exists()
        assert not list(Path("run").rglob("*.partial"))
        assert run(*TINY, IN_RUN)[0] == 0
        same_errors(errors(), errors(finished[0]))

    def test_full_disk_while_the_report_is_written(self, copied):
        size = Path("run/report.html").stat().st_size
        Path("run/report.html").unlink()
        code, err = self.run_with_files_up_to(size // 2000)  # KB: the figures have room, not the page
        assert code == 2
        assert re.fullmatch(rf"error: [^\n]*{Path.cwd()}/run/report\.html[^\n]*\n", err)
        assert not Path("run/report.html").exists()
        assert ran(copied) == []  # no record says that there is a report
