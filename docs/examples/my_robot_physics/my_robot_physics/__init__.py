"""Physics of my robot for warp_resphys."""
