"""Reads meshes of Abaqus and CalculiX (.inp): parts and their instances,
element sets, surfaces of sides of elements.

The name of a set or surface that several parts have begins with its instance. Keywords that say
nothing about the mesh are ignored; those that generate nodes or elements, or name other files, are
refused.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .arrays import FloatArray, IntArray
from .errors import DecodingError
from .mesh_blocks import Block, rows_of
from .text import decoded

# Instance or "" for the set's own scope; numbers of elements or name of a set.
Member = tuple[str, IntArray | str]

_SOLID = re.compile(r"C3D(\d+)(?!\d|V)")
_FACE = re.compile(r"(?:D?S|STRI|M3D|R3D|SFM3D|CPS|CPE|CAX)([34689])")
_OTHER_SOLID = re.compile(r"(A|D|E|P|CO)?C3D|Q3D|CIN3D|COH3D|GK3D|SC[68]|CSS8|CCL")
_SOLIDS = {
    4: "tetra",
    5: "pyramid",
    6: "wedge",
    8: "hexahedron",
    10: "tetra10",
    13: "pyramid13",
    15: "wedge15",
}
_SOLIDS |= {20: "hexahedron20"}
_FACES = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
_SIDES = {  # corners of the sides S1, S2, ... of solids
    "tetra": [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
    "hexahedron": [
        [0, 1, 2, 3],
        [4, 7, 6, 5],
        [0, 4, 5, 1],
        [1, 5, 6, 2],
        [2, 6, 7, 3],
        [3, 7, 4, 0],
    ],
}
_REFUSED = (
    "SYSTEM",
    "NGEN",
    "NFILL",
    "NCOPY",
    "NMAP",
    "ELGEN",
    "ELCOPY",
    "SYMMETRICMODELGENERATION",
    "PARAMETER",
)
# Keywords whose lines may be in another file.
_WITH_FILES = ("INCLUDE", "NODE", "ELEMENT", "ELSET", "SURFACE")


@dataclass
class _Scope:
    """Nodes, elements and sets of a part, of an instance, or of the model outside of parts."""

    nodes: dict[int, list[float]] = field(default_factory=dict)
    blocks: list[tuple[str, int, IntArray]] = field(default_factory=list)  # kind, dimension, cells
    sets: dict[str, list[Member]] = field(default_factory=dict)
    sides: dict[str, list[tuple[Member, int]]] = field(default_factory=dict)  # elements of surfaces
    motion: tuple[FloatArray, FloatArray] = (np.eye(3), np.zeros(3))  # rotation and translation

    @property
    def is_solid(self) -> bool:
        """Whether there are elements of three dimensions."""
        return any(dimension == 3 for _, dimension, _ in self.blocks)

    def instance(self, data: list[str]) -> "_Scope":
        """Returns an instance of this part, moved by the data lines of *INSTANCE:
        translated, then rotated.
        """
        rotation, translation = np.eye(3), np.zeros(3)
        for line in data:
            values = np.array([float(word) for word in line.split(",") if word.strip()])
            if len(values) == 7:
                first, axis = values[:3], values[3:6] - values[:3]
                cross = np.cross(np.eye(3), axis / np.linalg.norm(axis))
                angle = np.radians(values[6])
                rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
                translation = first + rotation @ (translation - first)
            else:
                translation = values
        motion = rotation, translation
        return _Scope({**self.nodes}, [*self.blocks], {**self.sets}, {**self.sides}, motion)


@dataclass
class _Deck:
    """Content of a file."""

    model: _Scope = field(default_factory=_Scope)
    parts: dict[str, _Scope] = field(default_factory=dict)
    instances: dict[str, _Scope] = field(default_factory=dict)
    spelling: dict[str, str] = field(default_factory=dict)  # first one; case does not matter
    hidden: set[str] = field(default_factory=set)  # names of internal sets

    def name(self, word: str) -> str:
        """Returns a name in upper case."""
        self.spelling.setdefault(word.upper(), word)
        return word.upper()

    def scopes(self) -> dict[str, _Scope]:
        """Returns the model's own scope and the instances by name.

        The parts if none has an instance.
        """
        return {"": self.model, **(self.instances or self.parts)}

    def shown(self, kind: str) -> dict[tuple[str, str], str]:
        """Returns names of all sets or sides by scope and name.

        Those of several scopes begin with their instance.
        """
        named = [(at, name) for at, scope in self.scopes().items() for name in getattr(scope, kind)]
        times, spelling = Counter(name for _, name in named), self.spelling
        return {
            (at, name): spelling[name]
            if times[name] == 1 or not at
            else f"{spelling[at]}_{spelling[name]}"
            for at, name in named
        }

    def members(
        self, scope: str, member: Member, *trail: tuple[str, str]
    ) -> Iterator[tuple[str, IntArray]]:
        """Yields scopes and numbers of the elements of a member of a set."""
        scope, content = member[0] or scope, member[1]
        if scope not in self.scopes():
            raise DecodingError(f"*ELSET: there is no *INSTANCE of the name '{scope}'")
        if not isinstance(content, str):
            yield scope, content
        elif (scope, content) in trail:
            raise DecodingError(f"*ELSET: the element set '{content}' contains itself")
        elif found := self.scopes()[scope].sets.get(content):
            for inner in found:
                yield from self.members(scope, inner, *trail, (scope, content))
        elif "." in content:  # such as beam-1.tip or beam-1.12
            instance, _, name = content.rpartition(".")
            yield from self.members(instance, _member(name), *trail)
        else:
            raise DecodingError(
                f"*ELSET: there is no element set '{content}' "
                "of which a set or surface could be made"
            )


def read_abaqus(path: str) -> tuple[FloatArray, list[Block]]:
    """Returns points (N, 3) and blocks of cells of an input file.

    Raises:
        DecodingError: a keyword or element that is not read, or a damaged file.
    """
    deck = _Deck()
    scope = deck.model
    for line, keyword, options, data in _cards(decoded(Path(path).read_bytes()) or ""):
        try:
            if keyword in _REFUSED:
                raise DecodingError(
                    "this keyword is not read; save the mesh "
                    "with all nodes and elements written out"
                )
            if keyword in _WITH_FILES and "INPUT" in options:
                raise DecodingError(
                    f"other files are not read; put the lines of {options['INPUT']} in its place"
                )
            if keyword == "PART":
                scope = deck.parts[deck.name(options["NAME"])] = _Scope()
            elif keyword == "INSTANCE":
                part = deck.parts.get(options.get("PART", "").upper())
                if part is None:
                    raise DecodingError(
                        f"the file has no *PART of the name '{options.get('PART', '')}'"
                    )
                scope = deck.instances[deck.name(options["NAME"])] = part.instance(data)
            elif keyword in ("ENDPART", "ENDINSTANCE"):
                scope = deck.model
            elif keyword == "NODE":
                scope.nodes |= _nodes(options, data)
            elif keyword == "ELEMENT":
                members = _elements(scope, options["TYPE"].upper(), data)
                if "ELSET" in options:
                    scope.sets.setdefault(deck.name(options["ELSET"]), []).append(("", members))
            elif keyword == "ELSET":
                name = deck.name(options["ELSET"])
                scope.sets[name] = [*scope.sets.get(name, []), *_set_members(options, data)]
                if "INTERNAL" in options:
                    deck.hidden.add(name)
            elif keyword == "SURFACE" and options.get("TYPE", "ELEMENT").upper() == "ELEMENT":
                rows = [_words(row) for row in data]
                if all(len(row) == 2 and re.fullmatch("[sS][1-6]", row[1]) for row in rows):
                    scope.sides[deck.name(options["NAME"])] = [
                        (_member(row[0]), int(row[1][1])) for row in rows
                    ]
        except KeyError as error:
            raise DecodingError(f"line {line}, *{keyword} needs {error.args[0]}=") from error
        except (DecodingError, ValueError) as error:
            raise DecodingError(f"line {line}, *{keyword}: {error}") from error
    return _arranged(deck)


def _cards(text: str) -> Iterator[tuple[int, str, dict[str, str], list[str]]]:
    """Yields line, keyword in upper case without blanks,
    options, and data lines of each keyword.
    """
    heads: list[tuple[int, list[str], list[str]]] = []
    for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
        if line.startswith("*") and not line.startswith("**"):
            heads.append((number, [line], []))
        elif line and not line.startswith("**"):
            if not heads:
                raise DecodingError(
                    f"line {number} comes before the first keyword; is it a file of Abaqus?"
                )
            head, data = heads[-1][1:]
            goes_on = not data and head[-1].endswith(",") and not line[0].isdigit()
            (head if goes_on else data).append(line)
    for number, head, data in heads:
        first, *words = "".join(head)[1:].split(",")
        pairs = [word.partition("=") for word in words]
        options = {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs}
        yield number, re.sub(r"\s", "", first).upper(), options, data


def _words(line: str) -> list[str]:
    return [word.strip().strip('"') for word in line.split(",") if word.strip()]


def _nodes(options: Mapping[str, str], data: list[str]) -> dict[int, list[float]]:
    if options.get("SYSTEM", "R").upper() != "R":
        raise DecodingError("only Cartesian coordinates are read, SYSTEM=R")
    nodes = {}
    for line in data:
        number, *words = line.split(",")
        places = [
            float(word.upper().replace("D", "E")) if word.strip() else 0.0 for word in words[:3]
        ]
        nodes[int(number)] = [*places, 0.0, 0.0][:3]
    return nodes


def _elements(scope: _Scope, kind: str, data: list[str]) -> IntArray:
    """Adds a block of elements.

    Returns their numbers, none for beams, springs and others that are ignored.
    """
    solid, face = _SOLID.match(kind), _FACE.match(kind)
    found = solid or face
    count = int(found[1]) if found else 0
    if count not in (_SOLIDS if solid else _FACES):
        if _OTHER_SOLID.match(kind):
            raise DecodingError(
                f"elements {kind} are not read; mesh the body with C3D4, C3D8, C3D10 or C3D20"
            )
        return np.empty(0, dtype=np.int64)
    rows = np.array([int(word) for line in data for word in _words(line)], dtype=np.int64)
    if rows.size % (1 + count):
        raise DecodingError(f"each {kind} must have a number and {count} nodes")
    rows = rows.reshape(-1, 1 + count)
    scope.blocks.append((_SOLIDS[count], 3, rows) if solid else (_FACES[count], 2, rows))
    return rows[:, 0]


def _set_members(options: Mapping[str, str], data: list[str]) -> Iterator[Member]:
    instance = options.get("INSTANCE", "").upper()
    for words in map(_words, data):
        if any(key.startswith("GEN") for key in options):
            first, last, step = ([int(word) for word in words] + [1])[:3]
            yield instance, np.arange(first, last + 1, step)
        else:
            yield (
                instance,
                np.array([int(word) for word in words if word.isdigit()], dtype=np.int64),
            )
            yield from ((instance, word.upper()) for word in words if not word.isdigit())


def _member(word: str) -> Member:
    return "", np.array([int(word)]) if word.isdigit() else word.upper()


def _groups(deck: _Deck) -> dict[tuple[str, str], list[IntArray]]:
    """Returns numbers of elements by the name of a set or instance, and by scope."""
    scopes, groups = deck.scopes(), dict[tuple[str, str], list[IntArray]]()
    parts = [at for at, scope in scopes.items() if scope.is_solid]
    for at, scope in scopes.items():
        if at in parts and len(parts) > 1:
            groups[deck.spelling.get(at, "model"), at] = [rows[:, 0] for _, _, rows in scope.blocks]
    for (at, name), shown in deck.shown("sets").items():
        for place, numbers in deck.members(at, ("", name)) if name not in deck.hidden else ():
            groups.setdefault((shown, place), []).append(numbers)
    return groups


def _arranged(deck: _Deck) -> tuple[FloatArray, list[Block]]:
    """Returns points and blocks of all instances."""
    groups, solids = _groups(deck), dict[str, list[tuple[str, IntArray, IntArray]]]()
    points, blocks = [np.empty((0, 3))], list[Block]()
    first = 0
    for at, scope in deck.scopes().items():
        numbers = np.array([*scope.nodes], dtype=np.int64)
        for kind, dimension, rows in scope.blocks:
            nodes = first + rows_of(numbers, rows[:, 1:])
            of_scope = {
                name: np.concatenate(members)
                for (name, place), members in groups.items()
                if place == at
            }
            cells = {
                name: np.flatnonzero(np.isin(rows[:, 0], members))
                for name, members in of_scope.items()
            }
            blocks.append(Block(kind, dimension, nodes, cells))
            if dimension == 3:
                solids.setdefault(at, []).append((kind, rows[:, 0], nodes))
        defined = Counter[int]()
        for _, _, rows in scope.blocks:
            defined.update(rows[:, 0].tolist())
        times = max(defined.values(), default=0)
        if times > 1:
            raise DecodingError(
                f"*ELEMENT: element {max(defined, key=defined.__getitem__)} is defined {times} "
                "times"
            )
        rotation, translation = scope.motion
        points.append(np.array([*scope.nodes.values()]).reshape(-1, 3) @ rotation.T + translation)
        first += len(numbers)
    for (at, name), shown in deck.shown("sides").items():
        chosen = defaultdict[tuple[str, int], list[IntArray]](list)  # elements by scope and side
        for member, side in deck.scopes()[at].sides[name]:
            for place, elements in deck.members(at, member):
                chosen[place, side].append(elements)
        for (place, side), members in chosen.items():
            for kind, numbers, nodes in solids.get(place, []):
                corners = _SIDES.get(kind.rstrip("0123456789"), [])[side - 1 : side]
                faces = nodes[np.isin(numbers, np.concatenate(members))]
                faces = faces[:, np.ravel(corners).astype(np.int64)]
                blocks.append(
                    Block(_FACES.get(faces.shape[1], ""), 2, faces, {shown: np.arange(len(faces))})
                )
    return np.concatenate(points), blocks
