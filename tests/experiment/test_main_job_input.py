"""The main job with settings, meshes, files and disks that it cannot use: one sentence, exit code 2."""

import re
import shutil
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest

from support.main_job import IN_RUN, SHORT, STAGES, TINY, errors, files, ran, run, same_errors
from warp_resphys import box_hexahedra

resource = pytest.importorskip("resource", reason="this system cannot limit a process")


class TestBadInput:
    @pytest.mark.parametrize(
        ("overrides", "key"),
        [
            ("simulation.youngs_modulus=0", "simulation: youngs_modulus is"),
            ("simulation.poissons_ratio=0.5", "simulation: poissons_ratio is"),
            ("time_step=0", "time_step is"),
            ("experiment=beam_oscilation", "'beam_oscilation'"),
            ("trainer.epoch=5", "'trainer.epoch'"),
            ("+simulation.stiffness=5", "'stiffness'"),
            ("simulation.youngs_modulus=soft", "simulation.youngs_modulus"),
            ("trainer.epochs=2.5", "trainer.epochs"),
            ("+in_the_loop=window", "'window'"),
            ("+in_the_loop={start:network}", "in_the_loop.start"),
            ("reconstruction.regularisation=-1", "reconstruction.regularisation"),
            ("network.kind=graph", "network.kind"),
            ("network.force_modes=1000", "1000 modes"),
            ("solver.name=gradient_descent", "solver.name"),
            ("integrator=rk4", "integrator is"),
            ("device=tpu", "device is"),
            ("seed=-1", "seed is"),
            ("gravity=[0,0]", "gravity is"),
            ("fixed=null", "fixed is null, and obstacles has none that the body lies on"),
            ("fixed.x=0.5", "no vertex lies within 1e-09 m of x = 0.5 m"),
            ("data.steps=0", "data.steps"),
            ("solver.relative_tolerance=1", "solver.relative_tolerance"),
            ("tip={x:9}", "no vertex lies within 1e-09 m of x = 9 m"),
            ("mesh.divisions=[10000,10000,1000]", "mesh.divisions"),
            ("mesh.divisions=[1000000,1,1]", "mesh.divisions"),
            ("network.width=1000000000", "network.width"),
            ("network.width=16000 network.layers=90 network.blocks=90", "network.width, layers and blocks make"),
            ("simulation.density=1e30", "the mesh is"),
            ("data.weights_g.train=[]", "data.weights_g.train"),
            ("data.weights_g.validation=[]", "data.weights_g.validation is empty"),
            ("data.weights_g.test=[]", "data.weights_g.test is empty"),
            ("data.weights_g.test=[90]", "data.weights_g"),
            ("data.weights_g.test=[-4]", "data.weights_g.test"),
            ("data.kind=drop", "data.kind"),
            ("solver.max_iterations=1", "the newton solver stopped after 1 iterations"),
            ("reconstruction.max_iterations=1", "Gauss-Newton reconstruction moved by"),
        ],
    )
    def test_settings(self, folder, overrides, key):
        code, err = run(*TINY, IN_RUN, *overrides.split(" "))
        self.check(code, err, key)

    @pytest.mark.parametrize("content", [None, b"", b"not a mesh", b"\x89HDF\r\n\x1a\n", "truncated", "surface"])
    def test_mesh(self, folder, content):
        box = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
        name = "box.vtu"
        if content in ("truncated", "surface"):
            faces = [("quad", box.cells[:, :4])] if content == "surface" else [("hexahedron", box.cells)]
            meshio.write(name, meshio.Mesh(box.vertices, faces))
            if content == "truncated":
                Path(name).write_bytes(Path(name).read_bytes()[:-300])
        elif content is not None:
            Path(name).write_bytes(content)
        code, err = run(*SHORT, IN_RUN, "mesh=file", f"mesh.path={name}")
        self.check(code, err, "box.vtu: ")

    def test_mesh_without_path(self, folder):
        code, err = run(*SHORT, IN_RUN, "mesh=file")
        self.check(code, err, "Missing mandatory value: path (at mesh.path)")

    @staticmethod
    def check(code, err, key):
        lines = [line for line in err.splitlines() if not line.startswith(tuple(f"{stage}: " for stage in STAGES))]
        assert code == 2
        assert len(lines) == 1
        assert lines[0].startswith("error: ")
        assert key in lines[0]
        written = {path.name for path in Path("run").rglob("*") if path.is_file()} if Path("run").exists() else set()
        assert not written & {"metrics.json", "report.html", "resphys.safetensors", "rollouts.h5"}
        assert not [name for name in written if name.endswith(".partial")]

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

    @pytest.mark.parametrize("damage", ["truncated", "foreign", "of another stage", "changed"])
    def test_a_damaged_file_in_the_run_folder_is_made_again(self, finished, copied, no_report, caplog, damage):
        path = Path("run/dataset.h5")
        if damage == "truncated":
            path.write_bytes(path.read_bytes()[:-1000])
        elif damage == "foreign":
            path.unlink()
            with h5py.File(path, "w") as file:
                file["q"] = np.zeros(3)
        elif damage == "of another stage":
            shutil.copy("run/rollouts.h5", path)
        else:
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 0xFF
            path.write_bytes(content)
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

    @pytest.mark.parametrize(
        ("kilobytes", "full"),
        [
            (172, "simulate_parts/part_000.h5"),
            (230, "reconstruct_resphys_parts/part0_000.h5"),
        ],
    )
    def test_full_disk(self, finished, folder, no_report, kilobytes, full):
        code, err = self.run_with_files_up_to(kilobytes)
        line = err.splitlines()[-1]
        assert code == 2
        assert line.startswith(f"error: disk is full while writing {folder}/run/{full}: free some space and run the")
        assert "Traceback" not in err
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
        assert run(*TINY, IN_RUN)[0] == 0
        assert ran(copied) == ["report"]
        assert Path("run/report.html").stat().st_size == pytest.approx(size, rel=0.01)
