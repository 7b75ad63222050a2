"""What the command line runs: plan, fly, draw and write files."""
