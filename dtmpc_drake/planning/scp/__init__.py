"""Sequential convex programming on Clarabel (the paper's section VII)."""
