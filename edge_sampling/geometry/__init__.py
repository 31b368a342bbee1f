"""The shapes of a scene: their edges, welded across meshes, and their outlines."""
