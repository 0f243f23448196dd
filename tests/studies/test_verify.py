"""Reference trajectories: the documented format, the comparison, and the command's exit codes."""

import numpy as np
import pytest

from support.command_line import outcome, refusal
from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, State, box_hexahedra, select_vertices
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.studies.verification import box_of_vertices, compare_with_reference, read_reference

pytestmark = pytest.mark.usefixtures("folder")
FILES = ("beam_tip_load_nu045.npz", "beam_tip_load_nu0499.npz", "beam_twist_nu0499.npz")


def verify(*arguments):
    """How the command ends."""
    return outcome("verify", *arguments, "hydra.run.dir=run")


@pytest.mark.parametrize("name", FILES)
def test_reference_is_reproduced(name, reference_data, device):
    reference = read_reference(reference_data / name)
    for solver in ("newton", "quasi_newton"):
        result = compare_with_reference(reference, SolverSettings(solver, relative_tolerance=1e-7), device)
        assert result.largest_error <= 1e-8
        assert 2 < result.iterations < 40


def test_reference_is_reproduced_by_projective_dynamics(reference_data):
    ended = verify(reference_data / FILES[0], "solvers=[projective_dynamics]", "tolerance=1e-6")
    assert ended.code == 0
    assert "beam_tip_load_nu045" in ended.out


@pytest.mark.slow
def test_all_references_are_reproduced_by_all_solvers(reference_data):
    assert verify(*(reference_data / name for name in FILES)).code == 0


def trajectory(mesh, steps=3):
    """A file's content, computed by the simulator itself."""
    constants = {"youngs_modulus": 1e5, "poissons_ratio": 0.4, "density": 1000.0}
    gravity, h = np.array([0.0, 0.3, -9.0]), 0.008
    fixed = select_vertices(mesh, x=mesh.vertices[:, 0].min())
    body = Body(mesh, fixed=fixed, mass="per_vertex", volume_integration="full")
    settings = SolverSettings("newton", relative_tolerance=1e-10)
    simulator = Simulator(body, Corotated(**constants), h, gravity, solver=settings)
    forces = 1e-3 * np.random.default_rng(0).normal(size=(steps, len(mesh.vertices), 3))
    rest = simulator.rest_state()
    v = 0.1 * (rest.q - rest.q[:, :1]) * (rest.q[..., :1] > mesh.vertices[:, 0].min())
    result = simulator.rollout(State(rest.q, v), steps, Inputs(external_force=simulator.tensor(forces)[:, None]))
    states = {"q": result.q[:, 0].numpy(), "v": result.v[:, 0].numpy()}
    return constants | {"dt": h, "gravity": gravity, "vertices": mesh.vertices, "f_ext": forces} | states


UNEVEN = box_hexahedra((1.0, 1.0, 1.0), (3, 2, 1))
UNEVEN = type(UNEVEN)(UNEVEN.vertices**1.5 * [0.05, 0.02, 0.01] + [0.2, -0.1, 0.3], UNEVEN.cells)
CONTENT = trajectory(UNEVEN)


def write(folder, name="file.npz", without=(), **changes):
    path = folder / name
    np.savez(path, **{key: value for key, value in (CONTENT | changes).items() if key not in without})
    return path


def test_any_box_grid_is_recovered():
    mesh = box_of_vertices(UNEVEN.vertices)
    np.testing.assert_array_equal(mesh.cells, UNEVEN.cells)
    np.testing.assert_array_equal(mesh.vertices, UNEVEN.vertices)


def test_every_solver_reproduces_a_file_of_another_grid(tmp_path):
    ended = verify(write(tmp_path))
    assert ended.code == 0
    lines = ended.out.splitlines()[-3:]
    assert [line.split()[1] for line in lines] == ["projective_dynamics", "quasi_newton", "newton"]
    assert all(float(line.split()[-1]) <= 1e-8 for line in lines)


@pytest.mark.parametrize("key", ["q", "youngs_modulus", "density", "dt", "gravity", "f_ext"])
def test_a_perturbed_file_fails(key, tmp_path):
    changed = np.array(CONTENT[key], dtype=float)
    if key == "q":
        changed[-1, -1, -1] += 2e-8
    else:
        changed *= 1.001
    ended = verify(write(tmp_path, **{key: changed}), "solvers=[newton]")
    assert ended.code == 1
    assert "exceeds 1e-08" in ended.out


def test_largest_error_is_a_distance(tmp_path):
    q = CONTENT["q"].copy()
    q[2, 5] += [3e-5, 0.0, 4e-5]
    settings = SolverSettings("newton", relative_tolerance=1e-8)
    result = compare_with_reference(read_reference(write(tmp_path, q=q)), settings)
    assert result.largest_error == pytest.approx(5e-5, rel=1e-4)


def test_one_bad_file_among_good_ones_fails(tmp_path):
    good, bad = write(tmp_path), write(tmp_path, "bad.npz", q=CONTENT["q"] + 1e-6 * (CONTENT["q"] > 0.23))
    assert verify(bad, good, "solvers=[newton]").code == 1


def test_no_convergence_fails(tmp_path):
    ended = verify(write(tmp_path), "solvers=[newton]", "max_iterations=1")
    assert ended.code == 1
    assert "not converged" in ended.out


@pytest.mark.parametrize(
    ("without", "changes", "message"),
    [
        (["f_ext", "dt"], {}, "lacks dt, f_ext"),
        (["v"], {"w": np.ones(3)}, "lacks v and has w"),
        ([], {"q": CONTENT["q"][:-1]}, r"q is \(3, 24, 3\)"),
        ([], {"gravity": np.ones(2)}, r"gravity is \(2,\)"),
        ([], {"density": np.ones(2)}, r"density is \(2,\)"),
        ([], {"dt": np.array("0.01")}, "dt is .* real numbers"),
        ([], {"v": np.full_like(CONTENT["v"], np.nan)}, "v has values that are not finite"),
        ([], {"dt": 0.0}, "dt is 0"),
        ([], {"vertices": CONTENT["vertices"][::-1]}, "24 vertices with 4 x 3 x 2 distinct coordinates"),
        ([], {"vertices": CONTENT["vertices"] * [1, 1, 0]}, "box grid"),
        ([], {"poissons_ratio": 0.5}, "poissons_ratio is 0.5"),
    ],
)
def test_foreign_content_is_refused(without, changes, message, tmp_path):
    path = write(tmp_path, without=without, **changes)
    with pytest.raises((DataFileError, InputError), match=message):
        read_reference(path)
    sentence = refusal("verify", path, "hydra.run.dir=run")
    assert sentence.startswith(f"error: {path}")
    assert sentence.count("\n") == 1


def test_foreign_files_are_refused(tmp_path):
    good = write(tmp_path).read_bytes()
    for name, content in {"text.npz": b"not an archive", "empty.npz": b"", "truncated.npz": good[:-200]}.items():
        (tmp_path / name).write_bytes(content)
        ended = verify(tmp_path / name)
        assert (ended.code, f"{name} is not a NumPy file" in ended.err) == (2, True)
    assert "does not exist" in verify(tmp_path / "missing.npz").err
    objects = verify(write(tmp_path, gravity=np.array([0.0, "x", None], dtype=object)))  # would need a pickle
    assert "is not a NumPy file of plain arrays" in objects.err
    np.save(tmp_path / "array.npy", np.ones(3))
    assert "is a single array" in verify(tmp_path / "array.npy").err


def test_bad_settings(tmp_path):
    assert "tolerance is 0" in refusal("verify", write(tmp_path), "tolerance=0")
    assert "name reference trajectories" in verify().err
