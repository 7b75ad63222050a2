"""Which way: starts on the sides of obstacles, compared on a coarse grid."""
