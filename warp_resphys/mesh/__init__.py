"""Rest shapes: meshes, readers, mesh quality, surfaces, chambers, and parametric pneumatic arms."""

from ..settings.mesh import ArmMesh as ArmMesh
from .arm import mesh_arm as mesh_arm
from .chambers import Chamber as Chamber
from .chambers import find_chambers as find_chambers
from .readers import read_surfaces as read_surfaces
from .readers import write_mesh as write_mesh
from .selection import select_faces as select_faces
from .tetrahedra import fill_surface as fill_surface
