"""Rest shapes: meshes, readers, mesh quality, surfaces, chambers, and parametric pneumatic arms."""
