"""What a plan is charged for, one cost a file."""
