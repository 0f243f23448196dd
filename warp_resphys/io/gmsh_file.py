"""Reads meshes of gmsh: MSH 2, 4.0 and 4.1, as text or binary
(https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format).

An entity of geometry can be in several physical groups. MSH 4 lists the groups of each entity; MSH
2 repeats its cells for each of them, which are read once. Only groups with a name are read. Other
sections, such as $Periodic, are ignored.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .arrays import FloatArray, IntArray
from .errors import DecodingError
from .mesh_blocks import Block, rows_of
from .text import decoded

Names = Mapping[tuple[int, int], str]  # of physical groups by dimension and number

_KINDS = {  # meshio's name, dimension and number of nodes by gmsh's number of a kind
    **{
        1: ("line", 1, 2),
        2: ("triangle", 2, 3),
        3: ("quad", 2, 4),
        4: ("tetra", 3, 4),
        5: ("hexahedron", 3, 8),
    },
    **{
        6: ("wedge", 3, 6),
        7: ("pyramid", 3, 5),
        8: ("line3", 1, 3),
        9: ("triangle6", 2, 6),
        10: ("quad9", 2, 9),
    },
    **{
        11: ("tetra10", 3, 10),
        12: ("hexahedron27", 3, 27),
        13: ("wedge18", 3, 18),
        14: ("pyramid14", 3, 14),
    },
    **{
        15: ("vertex", 0, 1),
        16: ("quad8", 2, 8),
        17: ("hexahedron20", 3, 20),
        18: ("wedge15", 3, 15),
    },
    **{19: ("pyramid13", 3, 13)},
}
_HEXAHEDRON20 = [*range(9), 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15]
_ORDERS = {  # gmsh's node at each place of VTK's order, where they differ
    "tetra10": [*range(8), 9, 8],
    "hexahedron20": _HEXAHEDRON20,
    "hexahedron27": [*_HEXAHEDRON20, 22, 23, 21, 24, 20, 25, 26],
}
_HEAD = re.compile(rb"^\$(?!End)(\w+)[ \t\r]*\n", re.MULTILINE)  # first line of a section


class _Numbers:
    """Numbers of a section, taken one after the other."""

    def __init__(self, content: bytes, is_text: bool, order: str) -> None:
        self._content = np.fromstring(content.decode(), sep=" ") if is_text else content
        self._order, self._at = order, 0

    def rows(self, count: int, kinds: str) -> FloatArray:
        """Returns the next rows (count, k).

        In binary files of the kinds i and q, integers of 4 and 8 bytes, and d.
        """
        if isinstance(self._content, bytes):
            kind = np.dtype(
                [(str(number), self._order + letter) for number, letter in enumerate(kinds)]
            )
            taken = np.frombuffer(self._content, kind, count, self._at)
            self._at += taken.nbytes
            return np.stack(
                [taken[name].astype(np.float64) for name in taken.dtype.names or ()], axis=1
            )
        end = self._at + count * len(kinds)
        if end > len(self._content):
            raise DecodingError("the file is not whole; save it again")
        numbers, self._at = self._content[self._at : end], end
        return numbers.reshape(count, len(kinds))

    def integers(self, count: int, kind: str = "i") -> IntArray:
        return self.rows(count, kind)[:, 0].astype(np.int64)

    def count(self) -> int:
        return int(self.integers(1, "q")[0])


def read_gmsh(path: str) -> tuple[FloatArray, list[Block]]:
    """Returns points (N, 3) and blocks of cells of a file of gmsh.

    Raises:
        DecodingError: an unknown version or kind of cell, or a damaged file.
    """
    sections = _sections(Path(path).read_bytes())
    if "MeshFormat" not in sections:
        raise DecodingError(
            "the file has no $MeshFormat; save the mesh by gmsh as version 4.1 or 2.2"
        )
    version, binary = re.split(rb"\s+", sections["MeshFormat"].strip())[:2]
    number, is_text = float(version), binary == b"0"
    mark = sections["MeshFormat"].partition(b"\n")[2][:4]
    order = ">" if mark == b"\0\0\0\1" else "<"
    names = {}
    for line in (decoded(sections.get("PhysicalNames", b"")) or "").splitlines():
        match = re.match(r'\s*(\d)\s+(-?\d+)\s+"(.*)"', line)
        if match:
            names[int(match[1]), abs(int(match[2]))] = match[3]
    if 2.0 <= number < 3.0:
        return _version_2(sections, names, is_text, order)
    if not 4.0 <= number <= 4.1:
        raise DecodingError(
            f"version {number:g} of gmsh's format is not read; save the mesh as version 4.1 or 2.2"
        )
    used = ("Entities", "PartitionedEntities", "Nodes", "Elements")
    return _version_4(
        {key: _Numbers(sections[key], is_text, order) for key in used if key in sections},
        number,
        names,
    )


def _sections(content: bytes) -> dict[str, bytes]:
    """Returns the content of the sections by name.

    Of a section without an end, all that follows.
    """
    sections, at = dict[str, bytes](), 0
    while head := _HEAD.search(content, at):
        end = content.find(b"$End" + head[1], head.end())
        at = len(content) if end < 0 else end
        sections.setdefault(head[1].decode(), content[head.end() : at])
    return sections


def _version_4(
    sections: Mapping[str, _Numbers], version: float, names: Names
) -> tuple[FloatArray, list[Block]]:
    """Reads a file of version 4.0 or 4.1, whose blocks belong to one entity each."""
    groups: dict[tuple[int, int], IntArray] = {}
    for key in ("Entities", "PartitionedEntities"):
        if key in sections:
            groups |= _entities(sections[key], key == "PartitionedEntities", version)
    numbers, points = _nodes(sections["Nodes"], version)
    elements, blocks = sections["Elements"], []
    is_new = version > 4.0
    for _ in range(elements.integers(4 if is_new else 2, "q")[0]):
        first, second, kind = elements.integers(3)
        dimension, entity = (first, second) if is_new else (second, first)
        name, _, nodes = _kind(kind)
        count = elements.count()
        cells = elements.rows(count, (1 + nodes) * ("q" if is_new else "i"))[:, 1:].astype(np.int64)
        named = [
            names.get((dimension, abs(group))) for group in groups.get((dimension, entity), ())
        ]
        members = {group: np.arange(count) for group in named if group is not None}
        cells = rows_of(numbers, cells)[:, _ORDERS.get(name, slice(None))]
        blocks.append(Block(name, int(dimension), cells, members))
    return points, blocks


def _entities(
    numbers: _Numbers, is_partitioned: bool, version: float
) -> dict[tuple[int, int], IntArray]:
    """Returns the physical groups of entities by their dimension and number."""
    groups = {}
    if is_partitioned:
        numbers.count()
        numbers.integers(2 * numbers.count())  # ghosts
    for dimension, count in enumerate(numbers.integers(4, "q")):
        for _ in range(count):
            entity = int(numbers.integers(1)[0])
            if is_partitioned:
                numbers.integers(2)  # parent
                numbers.integers(numbers.count())  # partitions
            numbers.rows(3 if dimension == 0 and version > 4.0 else 6, "d")  # bounding box
            groups[dimension, entity] = numbers.integers(numbers.count())
            if dimension:
                numbers.integers(numbers.count())  # boundary
    return groups


def _nodes(numbers: _Numbers, version: float) -> tuple[IntArray, FloatArray]:
    """Returns the numbers (N,) and places (N, 3) of the nodes of version 4."""
    is_new = version > 4.0
    nodes = []
    for _ in range(numbers.integers(4 if is_new else 2, "q")[0]):
        first, second, is_parametric = numbers.integers(3)
        count, places = numbers.count(), "d" * (3 + is_parametric * (first if is_new else second))
        if is_new:
            rows = np.concatenate([numbers.rows(count, "q"), numbers.rows(count, places)], axis=1)
        else:
            rows = numbers.rows(count, "i" + places)
        nodes.append(rows[:, :4])
    rows = np.concatenate(nodes)
    return rows[:, 0].astype(np.int64), rows[:, 1:]


def _version_2(
    sections: Mapping[str, bytes], names: Names, is_text: bool, order: str
) -> tuple[FloatArray, list[Block]]:
    """Reads a file of version 2, whose cells have the number of their group."""
    is_parametric = "ParametricNodes" in sections
    head, _, content = sections["ParametricNodes" if is_parametric else "Nodes"].partition(b"\n")
    numbers = _Numbers(content, is_text, order)
    if is_parametric:
        rows = np.empty((int(head), 4))
        for row in rows:
            row[:] = numbers.rows(1, "iddd")[0]
            dimension = numbers.integers(2)[0]
            numbers.rows(dimension if dimension < 3 else 0, "d")
    else:
        rows = numbers.rows(int(head), "iddd")
    tags, points = rows[:, 0].astype(np.int64), rows[:, 1:]
    head, _, content = sections["Elements"].partition(b"\n")
    if is_text:
        values = np.fromstring(content.decode(), sep=" ", dtype=np.int64).tolist()
    else:
        values = np.frombuffer(content[: len(content) // 4 * 4], order + "i4").tolist()
    cells: dict[int, list[list[int]]] = {}  # rows of a group and nodes by gmsh's number of the kind
    at, left = 0, int(head)
    while left > 0:
        if is_text:
            kind, tagged = values[at + 1 : at + 3]
            count = 1
        else:
            kind, count, tagged = values[at : at + 3]
        at += 3
        nodes = _kind(kind)[2]
        for _ in range(count):
            start = at + tagged + (0 if is_text else 1)
            group = values[start - tagged] if tagged else 0
            cells.setdefault(kind, []).append([abs(group), *values[start : start + nodes]])
            at = start + nodes
        left -= count
    return points, [
        _once(kind, np.array(rows, dtype=np.int64), names, tags) for kind, rows in cells.items()
    ]


def _once(number: int, rows: IntArray, names: Names, tags: IntArray) -> Block:
    """A block of cells from rows (m, 1 + k) of a group and nodes, and the same nodes once."""
    kind, dimension, _ = _kind(number)
    _, first, cell = np.unique(rows[:, 1:], axis=0, return_index=True, return_inverse=True)
    _, pair = np.unique(np.stack([rows[:, 0], cell.ravel()]), axis=1, return_index=True)
    stays = np.ones(len(rows), dtype=bool)
    stays[pair] = False  # a cell that is twice in a group is a fault, which `check_mesh` refuses
    stays[first] = True
    place = (np.cumsum(stays) - 1)[first[cell.ravel()]]
    groups = {}
    for group in np.unique(rows[:, 0]).tolist():
        if (dimension, group) in names:
            groups[names[dimension, group]] = np.unique(place[rows[:, 0] == group])
    nodes = rows_of(tags, rows[stays, 1:])[:, _ORDERS.get(kind, slice(None))]
    return Block(kind, dimension, nodes, groups)


def _kind(number: int) -> tuple[str, int, int]:
    if number not in _KINDS:
        raise DecodingError(
            f"cells of gmsh's kind {number} are above order 2; set Mesh.ElementOrder to 1 or 2"
        )
    return _KINDS[number]
