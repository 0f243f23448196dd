"""Configurations that cannot work are refused in one sentence, before anything runs."""

import pytest

from support.configured import check, composed
from support.main_job import TINY
from support.segment_run import TRACKED, place_segment
from warp_resphys.io.errors import ResphysError

BEAM = "mesh.divisions=[4,1,1]"
WALL = "{wall: {shape: half_space, position: [0,0,-1]}}"
FLOOR = "obstacles={floor: {shape: half_space, position: [0, 0, -0.005]}}"
BALL = (
    "+obstacles={ball: {shape: sphere, position: [0.08, 0.015, -0.02], radius: 0.01, moves: true}}"
)
MOVES = "data.obstacle_motion={ball: {swings: {a: {frequency: 1.0, translation: [0,0,0.01]}}}}"
BOX = "mesh:{kind:box_hexahedra,size:[0.08,0.02,0.02],divisions:[4,1,1]}"
HALVES = (
    "mesh={kind: box_hexahedra, size: [0.05, 0.03, 0.03], divisions: [5, 2, 2]}",
    "parts={tip: {mesh: {kind: box_hexahedra, size: [0.05, 0.03, 0.03], divisions: [5, 3, 3]}, "
    "shift: [0.05, 0, 0]}}",
    "glued=[{region: tip, at: {x: 0.05}, to: body}]",
)
MUSCLES = (
    "muscles={commanded:stress,stiffness:0,bundles:{front:{within:{x:[0,0.02]},direction:[0,0,1]}}}"
)
OFFSET = "identify.parameters.tendon_offset_1"
SLOPE = "+identify.parameters.pressure_slope_3"
LIMBS = (
    "experiment=starfish_limb",
    "data.folder=recordings",
    "data.train=[slow]",
    "data.test=[fast]",
)
LIMBS += (
    "data.trials=null",
    "+data.trials={slow: {file: slow.csv, labels: [M1,M2,M3,M4]}, "
    "fast: {file: fast.csv, labels: [N1,N2,N3,N4]}}",
    *(
        f"+markers.tracked.N{number}=[0,-0.007,{z}]"
        for number, z in enumerate((-0.06, -0.036, 0.04, 0.057), 1)
    ),
)
PLATE = ("experiment=beam_regions", "~markers.tracked", "markers.rigid_bodies={plate: {part: cap}}")
POSES = (
    "weak: {file: a.csv, inputs: [0,1]}, strong: {file: b.csv, inputs: [2,0]}, "
    "both: {file: c.csv, inputs: [1,1]}"
)
TENTACLE = (
    "experiment=tentacle",
    "data.folder=.",
    "data.folds=null",
    "data.train=[weak,strong]",
    "data.test=[both]",
)
TENTACLE += ("data.trials=null", f"+data.trials={{{POSES}}}", "data.validation=[]")
PRIOR = "prior: {mean: 1.0, deviation: 0.1}"

CASES = {
    ("experiment=finger_force",): [
        (
            r"^sensors\.load\.at: the body has no region 'lid': its mesh has no regions\.$",
            "sensors.load.at=lid",
        ),
        (
            r"sensors\.load\.axes names moments: give moment_noise, in N m, as well",
            "sensors.load.axes=[fz,tx]",
        ),
        (r"sensors\.load\.axes", "sensors.load.axes=[fw]"),
        (r"sensors\.load\.noise", "sensors.load.noise=0"),
    ],
    ("experiment=beam_oscillation", "+sensors.load={noise: 0.01}"): [
        (
            r"^sensors are read from recordings: set sensors to \{\}, "
            r"or take data\.kind recorded\.$",
            "seed=1",
        )
    ],
    tuple(TINY): [
        ("the mesh is", "simulation.density=1e30"),
        ("fixed is null, and obstacles has none that the body lies on", "fixed=null"),
        ("no vertex lies within 1e-09 m of x = 9 m", "tip={x:9}"),
        ("mesh.divisions", "mesh.divisions=[10000,10000,1000]"),
        ("data.weights_g.validation is empty", "data.weights_g.validation=[]"),
        ("data.weights_g", "data.weights_g.test=[90]"),
        (r"reconstruction\.method", "reconstruction=levenberg_marquardt"),
        (
            "shapes are bodies with the identified material .* but nothing is identified",
            "shapes=bodies",
        ),
    ],
    ("experiment=beam_oscillation",): [
        ("a.held is null, and so is inputs: give one of", f"+shapes.a={{{BOX},fixed:{{x:0.0}}}}"),
        (
            "is set, but held is set as well",
            f"+shapes.a={{{BOX},fixed:{{x:0.0}},held:{{twist_deg:9}},inputs:[1.0]}}",
        ),
        (
            "held.at is null: name the vertices",
            f"+shapes.a={{{BOX},fixed:{{x:0.0}},held:{{weight_g:9}}}}",
        ),
        (
            "inputs are given, but it has neither",
            f"+shapes.a={{{BOX},fixed:{{x:0.0}},inputs:[1.0]}}",
        ),
        (r"shapes\.a: .*no vertex", f"+shapes.a={{{BOX},fixed:{{x:0.5}},held:{{twist_deg:9}}}}"),
        (
            "selects fixed vertices",
            f"+shapes.a={{{BOX},fixed:{{x:0.0}},held:{{weight_g:9,at:{{x:0.0}}}}}}",
        ),
        (
            "^law: the simulator has materials by region, "
            "and one law is for one material: leave law out.$",
            "regions={root:{x:[0.0,0.05]},tip:{x:[0.05,0.1]}}",
            "simulation.regions={root:{},tip:{}}",
        ),
        (r"^law.terms is \['c20', 'c50'\]: it must be a list of c20, c30, ", "law.terms=[c20,c50]"),
        (
            "^law: simulation.model is law already: ",
            "simulation={model:law,bulk_1:1e6,c10:1e4,stiffness_damping:null,"
            "youngs_modulus:null,poissons_ratio:null}",
        ),
        (
            "^the material resists no change of shape: ",
            "simulation={model:law,bulk_1:1e6,stiffness_damping:null,"
            "youngs_modulus:null,poissons_ratio:null}",
            "law=null",
        ),
        (
            "^data.others.a.weight_g is 50 and twist_deg 10: ",
            "data.others.a={weight_g:50,twist_deg:10}",
        ),
        (
            "^data.others.a is .*: weight_g is 0 and twist_deg 0: ",
            "data.others.a=[{weight_g:50},{at:{x:0.05}}]",
        ),
        (
            "^data.others.a is .*: it must be one twist, or a list of",
            "data.others.a=[{weight_g:50},{twist_deg:9}]",
        ),
        (
            "data.others.a.at: no vertex lies",
            "data.others.a=[{weight_g:50},{weight_g:50,at:{x:0.3}}]",
        ),
        (
            "others names '120 g', which is a trial of data.weights_g: rename it",
            "data.others={120 g:{weight_g:50}}",
        ),
        ("law.relaxation_times.* must rise", "law.relaxation_times=[0.1,0.01]"),
        (
            "no law dragon_skin_11: give the law.json of a run, or one of 'dragon_skin_10'",
            "law=dragon_skin_11",
        ),
        (
            "time_step is 0.01 s and target.time_step 0.004 s: the first must be a multiple",
            "target.time_step=0.004",
        ),
        ("target.material: .*'tme_step'", "target.tme_step=0.005"),
        (
            "target: fibres is set, but chambers is null",
            "target.fibres={angles:[8.0],stiffness:1e4}",
        ),
        ("unknown key 'target.muscle', did you mean 'muscles'", "target.muscle={bundles:{}}"),
        (
            r"target.mesh: the simulator's vertex at \(0.1, .*\) m lies outside of this mesh: "
            r"both must be",
            "target.mesh={kind:box_hexahedra,size:[0.08,0.03,0.03],divisions:[8,3,3]}",
            "data.load={x:0.08}",
        ),
        (
            "data.load: no vertex lies within 1e-09 m of x = 0.1 m: the mesh reaches .*",
            "target.mesh={kind:box_hexahedra,size:[0.11,0.03,0.03],divisions:[8,3,3]}",
        ),
        (
            "target: integrator is midpoint, by which rigid parts ring: "
            "choose implicit_euler or bdf2",
            "target.regions={tip:{x:[0.05,0.1]}}",
            "target.rigid={tip:{}}",
            "target.integrator=midpoint",
        ),
        (
            "target.muscles.stiffness is 0, but not",
            "target.muscles={bundles:{a:{direction:[1,0,0]}},stiffness:0.0}",
        ),
        (
            "laboratory: its body takes muscle_stress of 1 muscle, "
            "but that of the simulator takes no input",
            "experiment=beam_real",
            "laboratory.muscles={bundles:{a:{direction:[0,0,1]}},commanded:stress,"
            "stiffness:80e3,toe:0.02}",
        ),
    ],
    (BEAM,): [
        ("contact is set, but obstacles has none: name an obstacle", "contact={friction: 0.5}"),
        ("within the obstacle 'floor' at rest", FLOOR, "obstacles.floor.position=[0,0,0.01]"),
        (
            "data.obstacle_motion.bar is of 'bar', but obstacles has 'ball'",
            BALL,
            MOVES.replace("ball", "bar"),
        ),
        (
            "ball moves 'ball': set obstacles.ball.moves to true",
            BALL,
            MOVES,
            "obstacles.ball.moves=false",
        ),
        ("is of 'ball', but target.obstacles has 'wall'", BALL, MOVES, f"target.obstacles={WALL}"),
        ("data.obstacle_motion.ball", BALL, "data.obstacle_motion={ball: recorded}"),
        ("swings.a.frequency is 80 Hz: it must be below 50 Hz", BALL, MOVES.replace("1.0", "80")),
    ],
    ("experiment=beam_pushed",): [
        (
            "recorded by a marker of its name, but markers.labels is assigned",
            "markers.labels=assigned",
        ),
        ("markers.frame is own, but base_motion and obstacle_motion", "markers.frame=own"),
        (
            "'mixed' is a static pose: obstacles cannot move in it",
            "laboratory.trials.mixed.begins=static",
        ),
    ],
    PLATE: [
        ("regions.cap: no cell has its centre", "regions.cap.x=[0.2,0.3]"),
        ("no region 'lid'", "rigid.lid.density=1000"),
        (
            "simulation.regions.tip: corotated has no parameter",
            "simulation.regions.tip.youngs_module=1e5",
        ),
        ("cap", "simulation.regions.cap.density=1000"),
        (
            "parameters: there is no parameter 'youngs_modulus'",
            "identify.parameters.youngs_modulus={lower: 1.0, upper: 2.0}",
        ),
        ("midpoint", "identify.integrator=midpoint"),
        ("at most 45, in degrees", "markers.rigid_bodies.plate.orientation_deviation=90"),
        ("plate.part is 'lid', but the rigid parts", "markers.rigid_bodies.plate.part=lid"),
        ("markers.rigid_bodies.plate.part and at", "markers.rigid_bodies.plate.at={x: 0.1}"),
        ("markers.rigid_bodies has 'Base - 1'", "markers.rigid_bodies={Base - 1: {part: cap}}"),
        ("markers.rigid_bodies need recordings", "markers.labels=assigned"),
        (
            "rigid_bodies.plate: ",
            "markers.rigid_bodies={plate: {part: null, at: {x: 0.1, y: 0.0}}}",
        ),
    ],
    HALVES: [
        (r"glued\[0\]: ", "glued=[{region: lid, at: {x: 0.05}, to: body}]"),
        ("no vertex lies in the symmetry plane", "symmetry={y: 0.5}"),
        (
            r"glued\[0\].at: no vertex of the region 'tip'",
            "glued=[{region: tip, at: {x: 0.0}, to: body}]",
        ),
        ("parts.tip.shift", "parts.tip.shift=[0,0]"),
        (
            r"parts\.body",
            "parts={body: {mesh: {kind: box_hexahedra, size: [1, 1, 1], divisions: [1, 1, 1]}}}",
        ),
        (r"regions\.tip", "regions={tip: {x: [0, 0.05]}}"),
        ("is glued twice", f"glued=[{HALVES[2][7:-1]}, {HALVES[2][7:-1]}]"),
    ],
    LIMBS: [
        ("markers.plane is .* twice", "markers.plane=[x,x]"),
        ("two trials have some markers in common", "data.trials.fast.labels=[N1,N2,N3,N4,M3]"),
        ("markers.tracked", "data.trials.fast.labels=[N1,N2,N4]"),
        ("markers.plane", "data.axes=null"),
        ("markers.frame", "data.base_motion=recorded"),
        ("identify.placement", "identify.placement={markers: 0.001}"),
        ("fixed.z is .*two rising", "fixed.z=[0.02,-0.02]"),
        ("no vertex lies within 1e-09 m of z = 0.2 to 0.3 m", "fixed.z=[0.2,0.3]"),
    ],
    TENTACLE: [
        ("data.axes is .*twice", "data.axes=[x,x,y]"),
        (
            "markers.reference names 1: static poses need 3 .*, or data.axes and one",
            "data.axes=null",
        ),
        ("tendon_offset_1_first.upper: guide 1 .* outside of", f"{OFFSET}_first.upper=0.03"),
        (
            "and its parts, tendon_offset_1_first, tendon_offset_1_second",
            f"+{OFFSET}={{lower: -1e-3, upper: 1e-3}}",
        ),
        (
            r"per names session, but the trial '(.*)' has none: set data\.trials\.\1\.session",
            "+identify.parameters.tendon_tension_factor={lower: 0.8, upper: 1.2, per: session, "
            f"{PRIOR}}}",
        ),
    ],
    ("experiment=tendon_rod",): [
        ("tendons.routes.left.guides is .*two or more", "tendons.routes.left.guides=[[0,0,0]]"),
        (
            "guide 1 of tendon 2.* mm outside of the body",
            "tendons.routes.left.guides=[[0.02,0,0],[0,0,-0.2]]",
        ),
        ("tendons.stiffness", "tendons.commanded=contraction"),
        ("left.offsets", "+tendons.routes.left.offsets=[[[1,0,0],[0,1,0],[0,0,1]]]"),
        ("3 tendons|the tendons have", "+tendons.routes.left.offsets=[[1,0,0]]"),
        ("'tendon_offset_1_left' to identify: choose from", f"+{OFFSET}_left={{lower:-1,upper:1}}"),
        (
            "tendons and muscles are two inputs of the body, but recordings have one: take one out",
            MUSCLES,
        ),
        (
            "no cell has its centre within x from 1 to 2",
            "muscles={commanded:null,stiffness:1e4,"
            "bundles:{a:{direction:[0,0,1],within:{x:[1,2]}}}}",
        ),
        ("routes.left.fixed_guides has all guides", "+tendons.routes.left.fixed_guides=[0,1]"),
        ("the route has guides 0 to 1", "+tendons.routes.left.fixed_guides=[2]"),
    ],
    ("experiment=tendon_rod_control", "mesh.layers=3", "mesh.nodes=20"): [
        ("control.tracked", "control.tracked=[Tip]"),
        ("control.models", "control.models=[simfree]"),
        ("control.receding", "control.models=[sysid]"),
        ("control.limits", "control.limits.high=9"),
        ("control.shapes", "control.shapes=[square]"),
        ("control.seconds", "control.seconds=[0.1]"),
        (
            "laboratory.trials",
            "+laboratory.trials.t000={payload: 0.01}",
            "data.payload_at={z: -0.2}",
        ),
        ("control.reduction.modes", "control.reduction.modes=[4,4]"),
        ("control is for a robot with markers", "data.folds=leave_one_out"),
        ("reduced model, which has no contact", FLOOR.replace("005", "5")),
        (
            "tendon_tension_zero_front is id.* plans",
            "+identify.parameters.tendon_tension_zero_front={lower:0,upper:1}",
        ),
    ],
    ("experiment=crawler",): [
        (
            "phases has 2 values, but the body has 3 muscles: give",
            "laboratory.trials.fast.waves.phases=[0,1]",
        ),
        (
            "waves.frequency is 60 Hz: it must be below 50 Hz",
            "laboratory.trials.fast.waves.frequency=60",
        ),
        ("fast.waves is set, but the trial begins static", "+laboratory.trials.fast.begins=static"),
        ("fast.waves is missing, which other trials have", "laboratory.trials.fast.waves=null"),
        ("waves is set, but the body has no inputs", "muscles=null", "laboratory.muscles=null"),
        (
            "data.base_motion moves the fixed vertices, but fixed is null",
            "data.base_motion=reference",
        ),
    ],
    (
        "experiment=beam_obstacle",
        "~obstacles",
        "~laboratory.obstacles",
        "~contact",
        "~laboratory.contact",
    ): [
        (
            "identify.integrator is midpoint",
            "identify.integrator=midpoint",
            "+self_contact={friction: 0.3}",
        )
    ],
    ("experiment=marker_ablation", "mesh.divisions=[4,2,2]", "ablation.counts=[1,4]"): [
        ("ablation.counts", "ablation.counts=[1,43]"),
        ("data.weights_g.observed", "data.weights_g.observed=[50,70]"),
        ("reconstruction is none, but ablation reconstructs", "reconstruction=none"),
    ],
    ("experiment=tiny", TRACKED): [
        ("chambers.count", "chambers.count=3"),
        ("nowhere is not a folder", "data.folder=nowhere"),
        ("leave no time between two rests", "laboratory.sequences.rest=1.0"),
        ("laboratory: fibre angles are", "laboratory.fibres.angles=[90.0]"),
        ("is its unit millimetres", "simulation.youngs_modulus=264"),
        (
            "'attached_mass_factor'",
            "+identify.parameters.attached_mass_factor={lower:0.5,upper:2.0}",
        ),
        ("data.input_scales", "data.folds=leave_one_out", "data.input_scales=[1.5]"),
        ("data.horizons", "data.horizons=[0.06,5.0]"),
        ("data.cutoff", "data.cutoff=80.0"),
        ("the first must be a multiple of the second", "laboratory.time_step=0.003"),
        ("correlation is ", "laboratory.sequences.correlation=[[1.0],[0.0]]"),
        ("identify.first_guess", "+identify.first_guess.pressure=0.04"),
        ("recordings have their own", "data.input_scales=[1.5]", "data.folder=.", "data.test=[a]"),
        (
            r"pressure_slope_3\.lower is -0\.1: .* not negative",
            f"{SLOPE}={{lower: -0.1, upper: 0.1}}",
        ),
    ],
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the experiment `tiny` and a recording."""
    folder = tmp_path_factory.mktemp("own")
    place_segment(folder)
    (folder / "a.h5").touch()
    return folder


@pytest.mark.parametrize(
    ("base", "case"),
    [
        pytest.param(base, case, id=" ".join(case[1:]))
        for base, cases in CASES.items()
        for case in cases
    ],
)
def test_a_configuration_that_cannot_work_is_refused(base, case, place, monkeypatch):
    monkeypatch.chdir(place)
    own = f"hydra.searchpath=[file://{place / 'configs'}]"
    said, *overrides = case
    with pytest.raises(ResphysError, match=said) as told:
        check(composed(own, *base, *overrides))
    assert "\n" not in str(told.value)
