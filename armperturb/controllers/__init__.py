"""What muscles do at each step: pure functions on arrays whose first axis is the trial."""
