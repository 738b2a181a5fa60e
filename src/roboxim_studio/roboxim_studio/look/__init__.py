"""A scene in three dimensions: the renderer's meshes and textures, cameras, contacts, the compass."""
