"""Rest shapes: meshes, their readers and quality, surfaces, chambers, and pneumatic arms of given measures.

From outside: `mesh.Mesh` and its boxes, `readers.read_mesh`, `chambers.find_chambers`, `arm.mesh_arm`.
"""
