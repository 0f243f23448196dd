"""Rest shapes: meshes, readers, mesh quality, surfaces, chambers, and parametric pneumatic arms.

Public: `mesh.Mesh` and its boxes, `readers.read_mesh`, `chambers.find_chambers`, `arm.mesh_arm`.
"""
