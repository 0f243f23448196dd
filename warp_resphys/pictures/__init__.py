"""Bodies seen by cameras: outlines, tracked points, depths and scans, and the physical parameters that explain them."""
