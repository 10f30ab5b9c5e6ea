"""Path-traced stand-ins for photographs: procedural textures, geometry, camera paths and the rendering of captures."""
