"""Tests of specimens: what was measured, and the stress of a law in closed form,
or of a simulated specimen.

Homogeneous deformations have a closed form (`energies.isochoric`). Where ends are glued, or an
indenter presses on a block, the specimen is simulated at a few strains, from which the stress is
interpolated; its derivatives by the parameters are those of the reactions at the end that moves.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from ...core.dynamics.simulator import Simulator
from ...core.energies.base import Energy
from ...core.energies.catalogue import make_material
from ...core.energies.contact.obstacle_contact import Contact
from ...core.energies.contact.touching_bodies import Sphere
from ...core.energies.isochoric import KINDS, TERMS, stress_columns
from ...core.fem.bodies import Body
from ...core.mesh.boxes import box_hexahedra
from ...core.mesh.rod import rod
from ...core.mesh.selection import select_vertices
from ...core.mesh.volume_mesh import Mesh
from ...core.stepping.inputs import Inputs
from ...io.arrays import BoolArray, Brief, FloatArray, IntArray
from ...io.errors import ConvergenceError, InputError, ResphysWarning, number_of, warn
from ...settings.specimen import LARGEST_SIZE
from .membranes import Membrane
from .stray_samples import strays

LEAST_SAMPLES: Final = 5  # of a test
LARGEST_STRAIN: Final = 20.0  # of a silicone; larger ones are in per cent
# Of elastomers, from brush-like ones to rubber of Shore A 95 [Pa].
SHEAR_MODULI: Final = (100.0, 1e8)
NUISANCES: Final = ("zero", "toe", "compliance")
_LEAST: Final = 0.02  # of the largest stress, below which errors are not relative to the stress
_LOWER: Final = (
    0.6  # share of the range of strains from which classes are fitted to predict the rest
)
_SLOPE: Final = 1e-5  # difference of strains for derivatives
_STRAINS: Final = 6  # at which a specimen is simulated
_GRADED: Final = 3  # times the cells across, of a quarter of a block under an indenter
_MARGIN: Final = 1.02  # of the largest simulated strain over the largest measured one
_SAME: Final = 1.2  # the largest such ratio with which simulated strains stay
_LONGEST: Final = 5.0  # times the cells across, along an edge
_NEAR: Final = 0.4  # size of the cells there, over the mean
_GAP: Final = (
    0.01  # distance of contact over the radius of the indenter, half of which counts as touching
)
_STIFF: Final = 1e6  # stiffness of its contact [Pa]
_GLUED: Final = ("tension", "compression", "shear")
_CHOICES: Final = "glued ends have tension, compression and shear, an indenter has indentation."

Machine = Mapping[str, float]  # zero [Pa], toe, compliance [1/Pa]


@dataclass(frozen=True)
class Specimen(Brief):
    """A specimen whose deformation is not homogeneous: a block or a cylinder along z, simulated.

    Its lower end is fixed. The upper one is glued to a plate that moves along z (tension,
    compression) or along x (shear), or an indenter without friction presses on its middle.

    Args:
        length: along z [m].
        section: width and thickness, along x and y, or the diameter alone [m].
        poissons_ratio: at small strains.
        indenter: radius of the spherical indenter [m]; None: glued ends.
        cells: cells across the thinnest direction.

    Raises:
        InputError: a length that is not positive, or an indenter on a cylinder.
    """

    length: float
    section: Sequence[float]
    poissons_ratio: float = 0.4995
    indenter: float | None = None
    cells: int = 2
    _simulators: dict[tuple[str, ...], Simulator] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    # depths (S, 1) and positions (S, N, 3) of the last solutions, by kind of test
    _last: dict[str, tuple[torch.Tensor, torch.Tensor]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        """Checks the sizes."""
        if not isinstance(self.section, Sequence) or len(self.section) not in (1, 2):
            raise InputError(
                f"section is {self.section}: give width and thickness, "
                "or the diameter, in a list [m]."
            )
        sizes = {
            "length": self.length,
            "section": min(self.section),
            "indenter": self.indenter or 1.0,
        }
        for name, size in sizes.items():
            if not (math.isfinite(size) and size > 0.0):
                raise InputError(f"{name} of a specimen is {size:g}: give a positive length, in m.")
            if name != "indenter" and size > LARGEST_SIZE:
                raise InputError(
                    f"{name} of a specimen is {size:g} m: "
                    f"give it in m, {1e-3 * size:g} for {size:g} mm."
                )
        if self.indenter is not None and len(self.section) == 1:
            raise InputError("an indenter presses on a block: give its width and thickness.")

    @property
    def area(self) -> float:
        """Undeformed cross-section [m^2]."""
        return (
            float(np.prod(self.section))
            if len(self.section) == 2
            else 0.25 * math.pi * self.section[0] ** 2
        )

    @cached_property
    def mesh(self) -> Mesh:
        """Quadratic hexahedra.

        Linear ones under an indenter, of whose contact no node then lies between others.
        """
        if len(self.section) == 1:
            radius = 0.5 * self.section[0]
            layers = math.ceil(self.length * self.cells / min(self.length, 2.0 * radius))
            return rod(
                [[0.0, 0.0, 0.0], [0.0, 0.0, self.length]],
                radius,
                layers,
                core=self.cells // 2 or 1,
            )
        size = np.array([*self.section, self.length])
        if self.indenter is None:
            divisions = np.minimum(np.ceil(size / size.min()), _LONGEST) * self.cells
            return box_hexahedra(size.tolist(), divisions.astype(int).tolist(), nodes=27)
        halves = _GRADED * self.cells
        block = box_hexahedra((2.0, 2.0, 1.0), (2 * halves, 2 * halves, halves))
        away = block.vertices - 1.0  # from the point under the indenter
        return Mesh(
            (away * (_NEAR + (1.0 - _NEAR) * np.abs(away)) + 1.0) * size * [0.5, 0.5, 1.0],
            block.cells,
        )

    @cached_property
    def moved(self) -> IntArray:
        """Vertices of the end that moves."""
        return select_vertices(self.mesh, z=self.length)

    def _simulator(self, terms: Sequence[str]) -> Simulator:
        """Returns the simulator of a specimen with a law that has some elastic terms."""
        fixed, energies = select_vertices(self.mesh, z=0.0), list[Energy]()
        if self.indenter is None:
            fixed = np.union1d(fixed, self.moved)
        else:
            ball = Sphere(
                radius=self.indenter,
                position=(
                    *(0.5 * np.array(self.section)),
                    self.length + (1.0 + _GAP) * self.indenter,
                ),
            )
            energies = [
                Contact({"indenter": ball}, stiffness=_STIFF, distance=_GAP * self.indenter)
            ]
        body = Body(self.mesh, fixed=fixed, energies=energies)
        material = make_material("law", **dict.fromkeys(("c10", *terms), 1e5), bulk_1=1e7)
        return Simulator(body, material, gravity=(0.0, 0.0, 0.0))

    def response(
        self, kind: str, strain: FloatArray, parameters: Mapping[str, float]
    ) -> tuple[FloatArray, dict[str, FloatArray], FloatArray]:
        """Returns the stress (N,) of a law in slow loading at strains (N,), and its derivatives.

        The derivatives are by the parameters, of which viscosity and branches have none, and by the
        strain.

        Raises:
            InputError: a kind of test that has no such specimen.
            ConvergenceError: the specimen has no equilibrium.
        """
        if kind not in (("indentation",) if self.indenter is not None else _GLUED):
            raise InputError(f"a {kind} test has no simulated specimen: {_CHOICES}")
        names = tuple(name for name in parameters if TERMS.fullmatch(name))
        if names not in self._simulators:
            self._simulators[names] = self._simulator(names)
        simulator = self._simulators[names]
        levels = self._levels(kind, float(strain.max()))
        values = {
            name: simulator.tensor([[parameters[name]]]).repeat(_STRAINS, 1) for name in names
        }
        for value in values.values():
            value.requires_grad_()
        bulk = simulator.tensor([[parameters["bulk_1"]]]).repeat(_STRAINS, 1)
        try:
            force = self._forces(
                simulator, kind, simulator.tensor(levels), {**values, "bulk_1": bulk}
            )
        except ConvergenceError as error:
            raise ConvergenceError(
                f"a simulated specimen has no equilibrium at strains up to {levels[-1]:.2g}: "
                "identify from smaller ones, or take the closed form, which needs free ends.",
                error.positions,
                error.report,
            ) from error
        by_parameters = torch.autograd.grad(force.sum(), [*values.values()])
        curve = _curve(levels, force, strain)
        columns = {
            name: _curve(levels, slope, strain)[0]
            for name, slope in zip(values, by_parameters, strict=True)
        }
        return (
            curve[0],
            {name: columns.get(name, np.zeros_like(strain)) for name in parameters},
            curve[1],
        )

    def _forces(
        self,
        simulator: Simulator,
        kind: str,
        strains: torch.Tensor,
        parameters: Mapping[str, torch.Tensor],
    ) -> torch.Tensor:
        """Returns the forces over the cross-section (S,) of equilibria at strains (S,)."""
        rest, depth = simulator.rest_positions, strains[:, None] * self.length
        whole = rest.expand(len(strains), -1, -1)
        if self.indenter is not None:
            shift = depth + 0.5 * _GAP * self.indenter
            away = (rest[:, :2] - simulator.tensor(self.section) / 2.0).norm(dim=1)
            above = (
                self.indenter
                - (self.indenter**2 - away.clamp_max(0.99 * self.indenter) ** 2).sqrt()
            )
            # Up to the indenter, at each place.
            room = self.length + above - depth - _GAP * self.indenter
            dented = torch.cat(
                [whole[..., :2], (whole[..., 2] * (room / self.length).clamp_max(1.0))[..., None]],
                -1,
            )
            given, dented = {**parameters, "obstacle_z": -shift}, self._near(kind, depth, dented)
            # Cells under the indenter are coarse, which hardly changes its force.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ResphysWarning)
                balance = simulator.static_equilibrium(
                    parameters=given, start=dented, after=simulator.state(dented)
                )
            self._last[kind] = depth, balance.q.detach()
            return simulator.reaction(balance).force[:, 2] / self.area
        axis, sign = (0 if kind == "shear" else 2), (-1.0 if kind == "compression" else 1.0)
        share, change = rest[:, 2] / self.length, torch.zeros_like(whole)
        change[..., axis] = sign * depth * share
        guess = whole + change
        if axis == 2:
            middle = rest[:, :2].mean(0)
            guess[..., :2] = (
                middle + (rest[:, :2] - middle) * (1.0 + sign * strains[:, None, None]) ** -0.5
            )
            guess[:, simulator.fixed] = (whole + change)[:, simulator.fixed]
        inputs = Inputs(fixed_positions=(whole + change)[:, simulator.fixed])
        balance = simulator.static_equilibrium(
            inputs, parameters, start=self._near(kind, depth, guess)
        )
        self._last[kind] = depth, balance.q.detach()
        return sign / self.area * simulator.reaction(balance, at=self.moved).force[:, axis]

    def _levels(self, kind: str, most: float) -> FloatArray:
        """Returns strains (S,) to simulate, the last ones
        where they still fit, whose solutions are known.
        """
        last = (
            self._last[kind][0][:, 0].cpu().numpy() / self.length
            if kind in self._last
            else np.zeros(1)
        )
        return (
            last
            if most <= last[-1] <= _SAME * most
            else np.linspace(0.0, _MARGIN * most, _STRAINS + 1)[1:]
        )

    def _near(self, kind: str, depth: torch.Tensor, guess: torch.Tensor) -> torch.Tensor:
        """Returns the last solution at the same depths (S, 1), or a guess (S, N, 3)."""
        known, last = self._last.get(kind, (depth[:0], guess))
        return last if torch.equal(known, depth) else guess


def _curve(
    levels: FloatArray, values: torch.Tensor, strain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns values and slopes (N,) at strains (N,) of a curve through the origin
    and values (S,) at levels (S,).
    """
    spline = CubicSpline(np.append(0.0, levels), np.append(0.0, values.detach().cpu().numpy()))
    return np.asarray(spline(strain)), np.asarray(spline(strain, 1))


@dataclass(frozen=True)
class MaterialTest(Brief):
    """A test of a specimen.

    Args:
        kind: ``tension``, ``compression``, ``biaxial``, ``planar``, ``shear``, ``indentation`` of a
            `Specimen`, or ``bulge`` of a `Membrane`.
        strain: (N,) nominal strains, angles of shear, depths over the thickness, or heights of a
            membrane's cap over its radius; positive in compression, too.
        stress: (N,) force over the undeformed cross-section, positive in compression, too, or
            pressure [Pa].
        seconds: (N,) rising times [s], which relaxing branches need; the specimen is relaxed at the
            first.
        zero: standard deviation of the zero of the stress [Pa]; 0 if it is known.
        toe: that of the strain at which the specimen becomes taut.
        compliance: that of the machine's displacement over the length of the specimen, by stress
            [1/Pa].
        specimen: simulated where the deformation is not homogeneous: between glued ends, under an
            indenter, or of a membrane under the weight of its cap.
        counted: (N,) samples that a law is identified from; None: all but `strays`. The others are
            its history.
        lines: (N,) of the samples in their file, for messages; None: they are counted from 1.

    Raises:
        InputError: an unknown kind; arrays that do not fit, are not finite, or have less than five
            samples that count; times that do not rise; negative or impossible strains, or negative
            stresses.
    """

    kind: str
    strain: FloatArray
    stress: FloatArray
    seconds: FloatArray | None = None
    zero: float = 0.0
    toe: float = 0.0
    compliance: float = 0.0
    specimen: Specimen | Membrane | None = None
    counted: BoolArray | None = None
    lines: IntArray | None = None

    def __post_init__(self) -> None:
        """Checks the samples."""
        inflated = isinstance(self.specimen, Membrane)
        indented = isinstance(self.specimen, Specimen) and self.specimen.indenter is not None
        fits = (self.kind == "indentation") == indented and (self.kind == "bulge") == inflated
        if self.kind not in (*KINDS, "indentation", "bulge") or not fits:
            raise InputError(
                f"kind is {self.kind!r}: choose from {', '.join(KINDS)}, indentation of a "
                "specimen with an indenter, or bulge of a membrane."
            )
        for name in ("strain", "stress", "seconds"):
            given = getattr(self, name)
            if given is not None:
                values = np.asarray(given, dtype=np.float64)
                object.__setattr__(self, name, values)
                if (
                    values.shape != np.shape(self.strain)
                    or values.ndim != 1
                    or not np.isfinite(values).all()
                ):
                    raise InputError(
                        f"{name} has the shape {values.shape}: "
                        "give a finite number for every sample."
                    )
        if (
            self.used.sum() < LEAST_SAMPLES
            or not np.any(self.stress[self.used])
            or not np.any(self.strain[self.used])
        ):
            raise InputError(
                f"{self.used.sum()} samples count: "
                f"give {LEAST_SAMPLES} or more, of a specimen under load."
            )
        if self.seconds is not None and not (np.diff(self.seconds) > 0.0).all():
            raise InputError(
                "seconds do not rise: sort the samples by time, "
                "and leave out those that repeat one."
            )
        self._check_signs()

    def _check_signs(self) -> None:
        """Refuses strains and stresses with the signs or units of another convention."""
        low, high = float(self.strain.min()), float(self.strain.max())
        if self.strain.sum() < 0.0 or self.stress.sum() < 0.0:
            raise InputError(
                f"{self.kind} has mostly negative strains or stresses: both count as positive, "
                "also in compression; change the signs of the table."
            )
        if (
            low <= -1.0
            or high > LARGEST_STRAIN
            or (self.kind in ("compression", "indentation") and high >= 1.0)
        ):
            raise InputError(
                f"{self.kind} has strains from {low:.3g} to {high:.3g}: give fractions of the "
                "length, not per cent, and the right length of the specimen."
            )

    @property
    def used(self) -> BoolArray:
        """(N,) samples that a law is identified from."""
        return self.valid if self.counted is None else np.asarray(self.counted & self.valid)

    @property
    def valid(self) -> BoolArray:
        """(N,) samples of the specimen, without `strays`."""
        return ~np.logical_or.reduce([np.zeros(len(self.strain), bool), *self.strays.values()])

    @cached_property
    def strays(self) -> dict[str, BoolArray]:
        """(N,) samples in dropouts and after a break, by a few words on them.

        See `stray_samples`.
        """
        return strays(self.strain, self.stress)

    @property
    def left_out(self) -> list[str]:
        """Sentences on `strays`."""
        said = list[str]()
        for words, rows in self.strays.items():
            at, count = np.flatnonzero(rows), int(rows.sum())
            named = f"sample {at[0] + 1}" if self.lines is None else f"line {self.lines[at[0]]}"
            which = (
                f"{named}, strain {self.strain[at[0]]:.3g}, stress "
                f"{1e-3 * self.stress[at[0]]:.3g} kPa"
            )
            more = f", and {number_of(count - 1, 'other')}" if count > 1 else ""
            total = number_of(len(rows), "sample")
            said.append(f"{count} of {total} left out, {words}: {which}{more}.")
        return said

    @property
    def weights(self) -> FloatArray:
        """(N,) reciprocals of the stresses that errors are relative to [1/Pa]."""
        size = np.abs(self.stress)
        return np.asarray(1.0 / np.maximum(size, _LEAST * size[self.used].max()))

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations of the unknown constants of the machine, by name."""
        return {name: value for name in NUISANCES if (value := float(getattr(self, name))) > 0.0}

    @property
    def lower(self) -> BoolArray:
        """(N,) samples that classes are fitted to: the lower part of the strains,
        or the first part of a hold.
        """
        size = np.abs(self.strain)
        low, high = float(size[self.used].min()), float(size[self.used].max())
        if self.seconds is not None and np.quantile(size[self.used], 0.25) > low + 0.9 * (
            high - low
        ):
            first, last = self.seconds[self.used][[0, -1]]
            return np.asarray(self.used & (self.seconds <= first + _LOWER * (last - first)))
        return np.asarray(self.used & (size <= low + _LOWER * (high - low)))

    def check(self, name: str) -> None:
        """Refuses a shear modulus that no elastomer has, of a test of a name,
        and warns of samples that are left out.

        Raises:
            InputError: it is outside of `SHEAR_MODULI`.
        """
        for note in self.left_out:
            warn(f"{name}: {note}")
        if self.kind not in KINDS or (
            isinstance(self.specimen, Specimen) and self.specimen.indenter is not None
        ):
            return
        # Of a shear modulus of 2 Pa.
        unit = stress_columns(self.kind, self.strain[self.used], ("c10",))["c10"]
        loaded = unit > 0.0
        modulus = (
            2.0 * abs(float(np.median(self.stress[self.used][loaded] / unit[loaded])))
            if loaded.any()
            else 0.0
        )
        low, high = SHEAR_MODULI
        if 0.0 < modulus < low or modulus > high:
            size = f"{modulus:.2g} Pa" if modulus < low else f"{1e-6 * modulus:.2g} MPa"
            than = (
                f"softer than all gels ({low:g} Pa)"
                if modulus < low
                else f"harder than rubber ({1e-6 * high:g} MPa)"
            )
            raise InputError(
                f"{name} has a shear modulus of about {size}, {than}: check the units of its "
                "stress or force, of its strain (a fraction, not per cent) "
                "and of the specimen (m, not mm)."
            )

    def taut(self, machine: Machine) -> FloatArray:
        """Returns the strains (N,) of the specimen, by the constants of the machine."""
        return np.asarray(
            self.strain - machine.get("toe", 0.0) - machine.get("compliance", 0.0) * self.stress
        )

    def response(
        self, strain: FloatArray, parameters: Mapping[str, float]
    ) -> tuple[FloatArray, dict[str, FloatArray], FloatArray]:
        """Returns the stress (N,) of a law at strains (N,), and its derivatives (N,) by the
        parameters and the strain.

        Raises:
            ConvergenceError: a simulated specimen has no equilibrium.
        """
        if self.specimen is not None:
            if isinstance(self.specimen, Membrane):
                low, high = self.strain[self.used].min(), self.strain[self.used].max()
                return self.specimen.response(np.clip(strain, low, high), parameters)
            # What does not count is not simulated.
            reach = _SAME * float(self.strain[self.used].max())
            return self.specimen.response(self.kind, np.minimum(strain, reach), parameters)

        def total(strain: FloatArray) -> tuple[FloatArray, dict[str, FloatArray]]:
            columns = stress_columns(self.kind, strain, tuple(parameters), self.seconds)
            return np.sum(
                [parameters[name] * column for name, column in columns.items()], axis=0
            ), columns

        value, columns = total(strain)
        return (
            value,
            columns,
            (total(strain + _SLOPE)[0] - total(strain - _SLOPE)[0]) / (2.0 * _SLOPE),
        )

    def away(self, parameters: Mapping[str, float], machine: Machine) -> FloatArray:
        """Returns the relative errors (N,) of a law, with the constants of the machine."""
        predicted = self.response(self.taut(machine), parameters)[0] + machine.get("zero", 0.0)
        return np.asarray((predicted - self.stress) * self.weights)
