"""The planar arm of the MJCF model as compiled equations of motion: thousands of trials in the time of a hundred."""
