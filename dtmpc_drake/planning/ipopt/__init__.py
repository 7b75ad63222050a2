"""The same problem as one nonlinear program, for IPOPT."""
