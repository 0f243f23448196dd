"""Cross-sections of pneumatic arms: outlines, and blocks of quadrilaterals that fill them.

Points of a section are complex numbers, x + iy [m]. Chamber 1 is towards +x; the others follow
counter-clockwise.

A mesh replaces curves by polygons. With corners on the curves, a coarse chamber would be too small
by a tenth, and the arm would bend less under pressure. So points on arcs are moved away from the
arc's centre, by a fraction of the radius for which the polygon has the area of the curve
(`Section.growth`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import asin, ceil, cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...io.arrays import FloatArray
from ...io.errors import MeshError

ComplexArray = NDArray[np.complex128]
# arcs of a chamber by profile: first letters of the names of their ends
_ARCS = {
    "half_disc": ("A", "AC"),
    "disc": ("A", "AC", "CM"),
    "sector": ("A", "CM"),
    "wedge": ("A",),
}
Edge = tuple[str, str]  # names of the ends, in alphabetical order if used as a key
Divisions = Mapping[Edge, int]
# Name, whether it is mirrored at the middle of its chamber, and index of the wedge.
Corner = tuple[str, bool, int]

SOLID = -1  # replaces the number of a chamber
_LEAST_ROOM = 0.1  # smallest size of a chamber, over the radius of the outline
_LARGEST_TURN = 1.15  # largest angle of an arc replaced by one edge [rad]


class Piece(NamedTuple):
    """A piece of an outline."""

    start: complex
    end: complex
    centre: complex | None  # of a circular arc of less than 180 degrees; None for a straight line

    def points(self, t: FloatArray) -> ComplexArray:
        """Returns the points at fractions (T,) of the length."""
        if self.centre is None:
            return np.asarray(self.start + (self.end - self.start) * t, dtype=np.complex128)
        # A complex power rotates and scales uniformly, so the ends may have different distances
        # from the centre.
        spoke = self.start - self.centre
        return np.asarray(
            self.centre + spoke * ((self.end - self.centre) / spoke) ** t, dtype=np.complex128
        )

    def moves(
        self, t: FloatArray, first: complex, last: complex, share: float = 1.0
    ) -> ComplexArray:
        """Returns displacements of these points: interpolated on a line,
        a share of the radius outwards on an arc.
        """
        if self.centre is None:
            return np.asarray(first * (1.0 - t) + last * t, dtype=np.complex128)
        moves = share * (self.points(t) - self.centre)
        moves[0], moves[-1] = first, last
        return moves

    @property
    def turn(self) -> float:
        """Angle of the arc [rad], positive counter-clockwise; 0 for a straight line."""
        return (
            0.0
            if self.centre is None
            else float(np.angle((self.end - self.centre) / (self.start - self.centre)))
        )

    @property
    def area(self) -> float:
        """Area between the piece and the origin [m^2], positive counter-clockwise."""
        triangle = 0.5 * (self.start.conjugate() * self.end).imag
        if self.centre is None:
            return float(triangle)
        return float(
            triangle + 0.5 * abs(self.start - self.centre) ** 2 * (self.turn - sin(self.turn))
        )


class Growth(NamedTuple):
    """Distances of the polygons' corners from the curves of chambers and outline,
    over the radii of the arcs.
    """

    chamber: float
    outline: float

    def of(self, name: str) -> float:
        """Returns the growth of the curve on which a named point lies, or with which it moves."""
        return self.outline if name[0] in "BV" else self.chamber


@dataclass(frozen=True)
class Section:
    """The cross-section of an arm at one height.

    The half wedge counter-clockwise from the middle of chamber 1 is described by named points, and
    mirrored:

        O                the axis
        M, C, (E)        inner side of the chamber: its middle, its corner, and the end of a
                         straight side along the web
        A0 to Am         outer arc of the chamber, from its last corner (C or E) to its crown
        B0 to Bm         the outline opposite the arc
        W, (U)           middle of the web opposite C (and E)
        (N, P, Q)        side of the hole along the axis: its middle, the point opposite C, and
                         its corner
        V                middle of the web on the outline; for a lobed outline the same as B0
        Xm, Xc, X1, X2   inside the chamber, next to M, C, A1 and A2, for the caps
    """

    radius: float  # largest radius of the outline [m]
    count: int  # number of chambers
    profile: str  # as in `ArmMesh`, like all that follows
    outline: str
    wall: float  # [m]
    web: float  # [m]
    core: float | None = None  # [m]; None: the smallest that the webs allow
    bore: float | None = None  # [m]; None: no hole along the axis

    @property
    def half_angle(self) -> float:
        """Angle between the middle of a chamber and the middle of the web beside it [rad]."""
        return pi / self.count

    @property
    def _between_webs(self) -> bool:
        """Whether a chamber is bounded by an arc about the axis and by straight webs."""
        return self.profile in ("sector", "wedge")

    @property
    def arc_centre(self) -> float:
        """Distance from the axis to the centre of the chamber's outer arc [m]."""
        reach = self.radius - self.wall
        s, c = sin(self.half_angle), cos(self.half_angle)
        if self._between_webs:
            return 0.0
        # With centre d and radius a = reach - d, the distance from the middle of the web is d s - a
        # c for the corner of a half disc and d s - a for a disc; it equals half the web.
        if self.profile == "half_disc":
            return (0.5 * self.web + reach * c) / (s + c) if self.core is None else self.core
        return (
            (0.5 * self.web + reach) / (s + 1.0) if self.core is None else 0.5 * (self.core + reach)
        )

    @property
    def arc_radius(self) -> float:
        """Radius of the outer arc of a chamber [m]."""
        return self.radius - self.wall - self.arc_centre

    @property
    def inner_radius(self) -> float:
        """Distance between the axis and a chamber [m]."""
        if self.profile == "half_disc":
            return self.arc_centre
        if self.profile == "disc":
            return self.arc_centre - self.arc_radius
        return self.web / sin(self.half_angle) if self.core is None else self.core

    def check(self) -> None:
        """Raises MeshError if the chambers do not fit."""
        where = f"where the arm's radius is {1e3 * self.radius:.4g} mm"
        d, a = self.arc_centre, self.arc_radius
        s, c = sin(self.half_angle), cos(self.half_angle)
        corner = (
            self._beside_web(self.inner_radius) if self.profile == "wedge" else self.inner_radius
        )
        room = a - abs(corner) if self._between_webs else a
        if room < _LEAST_ROOM * self.radius or self.inner_radius <= 0.0:
            raise MeshError(
                f"{where}, {self.count} chambers do not fit: "
                "make the wall, the web or the core thinner."
            )
        if self.core is not None:
            gaps = {
                "half_disc": d * s - a * c,
                "disc": d * s - a,
                "sector": self.core * s,
                "wedge": self.core * s,
            }
            gap = 2.0 * gaps[self.profile]
            if gap < self.web * (1.0 - 1e-9):
                raise MeshError(
                    f"{where}, a core of {1e3 * self.core:.4g} mm leaves webs of {1e3 * gap:.4g} "
                    f"mm between chambers, less than the {1e3 * self.web:.4g} mm that are asked "
                    "for: change the core, or set it to null."
                )
        if (
            self.bore is not None
            and not 0.5 * self.web / s < self.bore < self.inner_radius - 0.5 * self.web * s
        ):
            raise MeshError(
                f"{where}, a bore of {1e3 * self.bore:.4g} mm does not fit between the webs and "
                f"the chambers, {1e3 * self.inner_radius:.4g} mm from the axis: "
                "change the bore or the core."
            )
        if self.outline == "lobed" and not (d * s < a + self.wall and d * c < abs(self._valley())):
            raise MeshError(
                f"{where}, the lobes of the outline do not meet: "
                "make the wall thicker or the outline round."
            )

    def _valley(self) -> complex:
        """Returns the point of the outline at the middle of the web."""
        d = self.arc_centre
        s, c = sin(self.half_angle), cos(self.half_angle)
        if self.outline == "round":
            return complex(self.radius * c, self.radius * s)
        return (
            d * c + sqrt(max((self.arc_radius + self.wall) ** 2 - (d * s) ** 2, 0.0))
        ) * complex(c, s)

    @property
    def rows(self) -> int:
        """Number m of pieces in half of the outer arc."""
        return 1 if self._between_webs else 2

    @property
    def inner_side(self) -> tuple[str, ...]:
        """Names of the points on half of the inner side, from its middle."""
        return ("M", "C", "E") if self._between_webs else ("M", "C")

    @cached_property
    def points(self) -> Mapping[str, complex]:
        """The named points."""
        d, a = self.arc_centre, self.arc_radius
        half, valley = self.half_angle, self._valley()
        point = {"O": 0j, "M": complex(self.inner_radius), "V": valley}
        if self.profile == "sector":
            for name, radius in (("C", self.inner_radius), ("E", a)):
                point[name] = radius * np.exp(1j * (half - asin(0.5 * self.web / radius)))
        elif self.profile == "wedge":
            point["C"] = self._beside_web(self.inner_radius)
            point["E"] = a * np.exp(1j * (half - asin(0.5 * self.web / a)))
        elif self.profile == "half_disc":
            point["C"] = complex(d, a)
        else:  # the point with the thinnest wall towards the valley, or with the thinnest web
            lobe = valley - d if self.outline == "lobed" else np.exp(1j * (half / 2 + pi / 2))
            point["C"] = d + a * lobe / abs(lobe)
        last = point[self.inner_side[-1]]
        point["B0"] = valley if self.outline == "lobed" else self.radius * last / abs(last)
        for i, t in enumerate(np.linspace(0.0, 1.0, self.rows + 1)):
            point[f"A{i}"] = complex(Piece(last, complex(d + a), complex(d)).points(t))
            point[f"B{i}"] = complex(
                Piece(point["B0"], complex(self.radius), self._outline_centre).points(t)
            )
        if self.profile == "half_disc":
            point |= {"X1": d + (0.45 + 0.2j) * a, "X2": complex(d + 0.65 * a)}
        elif self.profile == "disc":
            point |= {
                f"X{name[-1].lower()}": 0.5 * (d + point[name]) for name in ("M", "C", "A1", "A2")
            }
        along = np.exp(1j * half)
        feet = [(point[name] / along).real for name in self.inner_side[1:]]
        if self.outline == "lobed":  # opposite the valley, at the same distance from the corners
            feet[-1] = max(2.0 * feet[-1] - abs(valley), 0.5 * feet[-1])
        for name, foot in zip("WU", feet, strict=False):
            point[name] = foot * along
        if self.bore is not None:
            point |= {
                "N": complex(self.bore),
                "P": self._beside_web(self.bore),
                "Q": self.bore / cos(half) * along,
            }
        return point

    def _beside_web(self, x: float) -> complex:
        """Returns the point of a distance x along the middle of the chamber
        on the extended side of the web.
        """
        return complex(x, x * np.tan(self.half_angle) - 0.5 * self.web / cos(self.half_angle))

    @property
    def _outline_centre(self) -> complex:
        """Centre of the outline's arc opposite chamber 1."""
        return complex(self.arc_centre if self.outline == "lobed" else 0.0)

    def piece(self, first: str, last: str) -> Piece:
        """Returns the piece between two neighbouring named points."""
        letters = "".join(sorted({first[0], last[0]}))
        centre: complex | None = None
        if letters == "B" or (letters == "BV" and self.outline == "round"):
            centre = self._outline_centre
        elif letters in _ARCS[self.profile]:
            centre = complex(self.arc_centre)
        return Piece(self.points[first], self.points[last], centre)

    def motion(self, name: str) -> complex:
        """Returns the displacement of a named point per unit of growth.

        Corners are fixed, or keep the web's width.
        """
        point, along = self.points[name], complex(np.exp(1j * self.half_angle))
        if name[0] in "AMCE":
            flat = {"half_disc": ("A0", "C", "M"), "wedge": ("C", "M")}.get(self.profile, ())
            if self._between_webs and name not in ("M", "A1", *flat):
                return (point / along).real * along
            return 0j if name in flat else point - self.arc_centre
        if name[0] in "BV":
            return (
                0j
                if self.outline == "lobed" and name in ("B0", "V")
                else point - self._outline_centre
            )
        if name == "W" and self.profile == "disc":  # moves with the opposite corner, as in `points`
            return (
                (2.0 if self.outline == "lobed" else 1.0) * (self.motion("C") / along).real * along
            )
        return 0j

    def divisions(self, size: float) -> Divisions:
        """Returns the number of mesh edges on each line between named points,
        for an average edge length [m].

        Opposite sides of a block have the same number, which propagates through the blocks: walls,
        flat sides and arcs of chambers have separate numbers, from the lengths of the solid parts.
        No edge replaces more than about 65 degrees of an arc.
        """
        strips: list[list[Edge]] = []
        solid: set[Edge] = set()
        for corners, chamber in self.blocks():
            names = [name for name, _, _ in corners]
            if chamber == SOLID:
                solid.update(
                    self.edge(*pair) for pair in zip(names, names[1:] + names[:1], strict=True)
                )
            for pair in (0, 1):
                sides = [self.edge(names[i], names[(i + 1) % 4]) for i in (pair, pair + 2)]
                joined = [strip for strip in strips if not set(sides).isdisjoint(strip)]
                strips = [strip for strip in strips if strip not in joined]
                strips.append(sorted({*sides, *(edge for strip in joined for edge in strip)}))
        numbers = {}
        for strip in strips:
            solid_edges = [edge for edge in strip if edge in solid]
            pieces = [self.piece(*edge) for edge in solid_edges or strip]
            least = ceil(max(abs(piece.turn) for piece in pieces) / _LARGEST_TURN)
            length = float(np.mean([abs(piece.end - piece.start) for piece in pieces]))
            numbers.update(dict.fromkeys(strip, max(1, least, round(length / size))))
        return numbers

    def edge(self, first: str, last: str) -> Edge:
        """Returns the key of the line between two named points, with synonyms resolved."""
        same = {"A0": self.inner_side[-1], **({"B0": "V"} if self.outline == "lobed" else {})}
        a, b = sorted((same.get(first, first), same.get(last, last)))
        return a, b

    def growth(self, divisions: Divisions) -> Growth:
        """Returns the growth for which the polygons have the areas of the curves."""
        return Growth(
            *(
                self._polygon(sides, divisions)[1]
                for sides in (self._chamber_sides, self._outline_sides)
            )
        )

    @property
    def _chamber_sides(self) -> tuple[Edge, ...]:
        """Pairs of neighbouring names along half of a chamber's outline, from its crown."""
        arc = [f"A{i}" for i in range(self.rows, -1, -1)]
        return (*pairwise(arc), *pairwise(self.inner_side[::-1]))

    @property
    def _outline_sides(self) -> tuple[Edge, ...]:
        """Pairs of neighbouring names along half of the outline opposite a chamber, from its
        crown.
        """
        arc = [f"B{i}" for i in range(self.rows, -1, -1)]
        return tuple(pairwise(arc if self.outline == "lobed" else [*arc, "V"]))

    def _polygon(self, sides: Sequence[Edge], divisions: Divisions) -> tuple[ComplexArray, float]:
        """Returns the polygon's corners along the sides, and its growth.

        A polygon with corners p + e w has the area A0 + A1 e + A2 e^2, which must equal that of the
        curve.
        """
        start, move = [], []
        area = 0.0
        for first, last in sides:
            piece = self.piece(first, last)
            t = np.linspace(0.0, 1.0, divisions[self.edge(first, last)] + 1)
            area += piece.area
            start.append(piece.points(t))
            move.append(piece.moves(t, self.motion(first), self.motion(last)))
        p, w = _chained(start), _chained(move)
        a0, a2 = _fan(p, p), _fan(w, w)
        a1 = _fan(p, w) + _fan(w, p)
        lack = area - a0
        growth = float(2.0 * lack / (a1 + sqrt(a1**2 + 4.0 * a2 * lack)))
        return np.asarray(p + growth * w, dtype=np.complex128), growth

    def chamber_polygon(self, divisions: Divisions) -> ComplexArray:
        """Returns the corners of chamber 1, counter-clockwise from its crown."""
        upper, _ = self._polygon(self._chamber_sides, divisions)
        return np.concatenate([upper, upper[-2:0:-1].conj()])

    def body_polygon(self, divisions: Divisions) -> ComplexArray:
        """Returns the corners of the arm's outline, counter-clockwise from chamber 1."""
        half, _ = self._polygon(self._outline_sides, divisions)
        turns = np.exp(2j * self.half_angle * np.arange(self.count))
        wedge = np.concatenate([half[:0:-1].conj(), half[:-1]])
        return np.asarray((turns[:, None] * wedge).ravel(), dtype=np.complex128)

    def line(self, first: Corner, last: Corner, t: FloatArray, growth: Growth) -> ComplexArray:
        """Returns the points at fractions (T,) of the line
        between two neighbouring corners, after the growth.
        """
        start, end = (self._placed(self.points[corner[0]], corner) for corner in (first, last))
        by_start, by_end = (
            self._placed(growth.of(c[0]) * self.motion(c[0]), c) for c in (first, last)
        )
        centre = self.piece(first[0], last[0]).centre
        piece = Piece(start, end, None if centre is None else self._placed(centre, first))
        return piece.points(t) + piece.moves(t, by_start, by_end, growth.of(first[0]))

    def _placed(self, point: complex, corner: Corner) -> complex:
        """Maps a point of the half wedge to the wedge of a corner."""
        _, mirrored, wedge = corner
        return (point.conjugate() if mirrored else point) * complex(
            np.exp(2j * self.half_angle * wedge)
        )

    def blocks(self) -> Iterator[tuple[list[Corner], int]]:
        """Yields the blocks that fill the section: four corners,
        and the index of the chamber or `SOLID`.
        """
        m, n = self.rows, self.count
        inner, middle = self.inner_side, ("O", "W", "U")
        solid = [("N", "M", "C", "P"), ("P", "C", "W", "Q")] if self.bore is not None else []
        solid += [
            (middle[i], inner[i], inner[i + 1], middle[i + 1])
            for i in range(len(solid) // 2, len(inner) - 1)
        ]
        solid += [(f"A{i}", f"B{i}", f"B{i + 1}", f"A{i + 1}") for i in range(m)]
        if self.outline == "round":
            solid.append((middle[len(inner) - 1], inner[-1], "B0", "V"))
        hollow = {
            "half_disc": [("M", "X1", "A1", "C"), ("X1", "X2", "A2", "A1")],
            "disc": [
                ("M", "Xm", "Xc", "C"),
                ("C", "Xc", "X1", "A1"),
                ("A1", "X1", "X2", "A2"),
                ("Xm", "X2", "X1", "Xc"),
            ],
            "sector": [("M", "A1", "A0", "C")],
            "wedge": [("M", "A1", "A0", "C")],
        }[self.profile]
        for j in range(n):
            for mirrored in (False, True):
                yield from (([(name, mirrored, j) for name in names], SOLID) for names in solid)
                yield from (([(name, mirrored, j) for name in names], j) for names in hollow)
            if self.profile == "half_disc":
                yield [("M", False, j), ("X1", True, j), ("X2", False, j), ("X1", False, j)], j
            if self.outline == "lobed":
                corner, back = inner[-1], middle[len(inner) - 1]
                yield (
                    [
                        (back, False, j),
                        (corner, False, j),
                        ("V", False, j),
                        (corner, True, (j + 1) % n),
                    ],
                    SOLID,
                )


def _chained(parts: Sequence[ComplexArray]) -> ComplexArray:
    """Returns the points of successive sides, without the first of every later side."""
    return np.concatenate([parts[0][:1], *(part[1:] for part in parts)])


def _fan(a: ComplexArray, b: ComplexArray) -> float:
    """The bilinear form whose quadratic form is the area between an open polygon and the origin."""
    return float(0.5 * (a[:-1].conj() * b[1:]).imag.sum())
