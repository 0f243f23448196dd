"""Bodies seen by cameras: outlines and tracked points in pictures, and the physical parameters that explain them."""
