"""Rest shapes: meshes, readers, mesh quality, surfaces, chambers, and parametric pneumatic arms.

Public: `volume_mesh.Mesh`, `boxes`, `readers.read_mesh`, `chambers.find_chambers`, `arm.mesh_arm`.
"""
