"""Rest shapes: meshes, readers, mesh quality, surfaces, chambers, and parametric pneumatic arms."""

from .core.mesh.arm import mesh_arm as mesh_arm
from .core.mesh.arm_dimensions import ArmMesh as ArmMesh
from .core.mesh.chambers import Chamber as Chamber
from .core.mesh.chambers import find_chambers as find_chambers
from .core.mesh.readers import read_surfaces as read_surfaces
from .core.mesh.readers import write_mesh as write_mesh
from .core.mesh.selection import select_faces as select_faces
from .core.mesh.tetrahedra import fill_surface as fill_surface

__path__: list[str] = []  # modules below it have moved (`moved`)
